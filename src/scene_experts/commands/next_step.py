"""The line that proposes a training."""

from __future__ import annotations

import shlex
from pathlib import Path

from scene_experts.commands import PROG


def propose_training(capture: Path, width: int, height: int, views: int) -> str:
    """Return a command that trains on `views` photographs of this size, with its estimated time here."""
    from scene_experts.bench.advice import suggest

    advice = suggest(width, height, views)
    time = f"  # {advice}" if str(advice) else ""
    return f"next: {shlex.join([PROG, 'train', 'scene-experts', '--data', str(capture), '--out', 'RUN', *advice.flags])}{time}"
