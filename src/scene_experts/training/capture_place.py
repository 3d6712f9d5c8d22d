"""Store the location of a run's capture. The run finds the capture from any folder, also after both
have moved together. `Lone` is for scenes that were opened without a run folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene_experts.data.views import Capture, Vector

KEY = "capture_from_run"
"""Key of config.json: the capture's path relative to the run folder."""


@dataclass(frozen=True)
class Lone:
    """What a scene has that was opened from a file and not from a run folder."""

    source: Path
    """What was read: a file, or an iteration's folder of a result folder."""
    name: str
    """Of the files that it is exported to, without a suffix."""
    capture: Capture | None
    """Cameras without photographs, in place of the capture; None where a capture was given."""
    origin: Vector
    """Place in the frame of the scene's capture that the positions of the file are relative to."""
    note: dict[str, Any]
    """Facts of its description that a file written from it keeps."""


def absolute(path: Path) -> Path:
    """Return the absolute path without `..`. Symbolic links are not resolved."""
    return Path(os.path.abspath(path))


def from_run(run: Path, path: Path) -> str | None:
    """Return the path of a capture relative to its run folder, or None if there is none (two drives
    on Windows)."""
    try:
        return Path(os.path.relpath(path, run)).as_posix()
    except ValueError:
        return None


def find(run: Path, path: Path, relative: str | None) -> Path:
    """Return the folder of a run's capture.

    Args:
        run: The run folder.
        path: Absolute path of the capture in config.json; tried first.
        relative: Path of the capture relative to the run folder in config.json, or None.

    Returns:
        The first path that exists, as an absolute path, or `path` if none exists.
    """
    places = [path] if relative is None else [path, absolute(run) / relative]
    return next((absolute(place) for place in places if place.exists()), path)
