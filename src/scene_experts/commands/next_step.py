"""The line that proposes a training."""

from __future__ import annotations

import shlex

from scene_experts.commands import PROG
from scene_experts.data.settings import Data


def propose_training(data: Data, width: int, height: int, views: int) -> str:
    """Return a command that trains on `views` photographs of this size, read as `data` says, with
    its estimated time here.

    The resolution is the one that is estimated, not that of `data`.
    """
    import torch

    from scene_experts.api.command_line import changes, words_of
    from scene_experts.bench.advice import suggest
    from scene_experts.bench.machine import measure_share
    from scene_experts.data.fetch.catalog import defaults_of
    from scene_experts.sfm.drift import drifts
    from scene_experts.training.recipes import PROPOSED

    plain = Data(data.path, resolution=data.resolution, normalise=defaults_of(data.path).normalise)
    read = [word for place, value in changes(plain, data) or [] for word in words_of(place, value)]
    read += ["--exposure"] if drifts(data.path) else []
    advice = suggest(width, height, views)
    told = "" if advice.minutes is None else advice.tell(measure_share(torch.get_num_threads()))
    time = f"  # {told}" if told else ""
    return f"next: {shlex.join([PROG, 'train', PROPOSED, '--data', str(data.path), '--out', 'RUN', *read, *advice.flags])}{time}"
