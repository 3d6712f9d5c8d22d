"""Load a capture with settings given by name."""

from pathlib import Path
from typing import Any

from scene_experts.data import capture
from scene_experts.data.capture import Capture
from scene_experts.data.settings import Data


def load(path: Path | str, *, seed: int = 0, allow_no_points: bool = False, cache_bytes: int | None = None, **data: Any) -> Capture:
    """Load the capture in a folder with settings of `Data` by name."""
    return capture.load(Data(Path(path), **data), seed, allow_no_points=allow_no_points, cache_bytes=cache_bytes)
