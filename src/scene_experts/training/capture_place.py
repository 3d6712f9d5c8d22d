"""Where the capture of a run is: written so that the run finds it again from any folder, and after both have moved together."""

from __future__ import annotations

import os
from pathlib import Path

KEY = "capture_from_run"
"""Key of config.json: the capture's path relative to the run folder. Earlier runs do not have it."""


def absolute(path: Path) -> Path:
    """The path from the root, without `..`; links stay as they are."""
    return Path(os.path.abspath(path))


def from_run(run: Path, path: Path) -> str | None:
    """The path of a capture relative to its run folder; None where there is none, as between two drives of Windows."""
    try:
        return Path(os.path.relpath(path, run)).as_posix()
    except ValueError:
        return None


def find(run: Path, path: Path, relative: str | None) -> Path:
    """The capture of a run. path, relative: what its config.json says.

    An absolute path is tried first, then the path relative to the run folder. Earlier runs keep the path as their training was given
    it; if that is relative, it is tried from the current folder, from the run folder and from each folder above that.
    Returns `path` where none of these exists.
    """
    here = absolute(run)
    places = [path] if path.is_absolute() else [path, *(folder / path for folder in (here, *here.parents))]
    if relative is not None:
        places.append(here / relative)
    return next((absolute(place) for place in places if place.exists()), path)
