"""The files in a folder of photographs, without what this program and others wrote there."""

from __future__ import annotations

import os
from pathlib import Path

from scene_experts.core.errors import few
from scene_experts.sfm.drift import NOTE
from scene_experts.sfm.work import NAME as WORK

POINT_CLOUD, CHECKPOINTS, SOURCE = "point_cloud", "checkpoints", "source.json"


def list_files(folder: Path, exclude: Path | None, written: list[Path] | None = None) -> list[Path]:
    """Return the files in `folder` and its subfolders except hidden ones, `exclude`, and folders with
    results (`holds_results`), which are added to `written`. Symbolic links are followed."""
    out, seen = [], set()
    for place, folders, files in os.walk(folder, followlinks=True):
        here = Path(place).resolve()
        folders[:] = [name for name in folders if not name.startswith(".")]
        top = here == folder.resolve()
        if here in seen or (exclude is not None and here == exclude.resolve() and not top):
            folders.clear()
            continue
        seen.add(here)
        if not top and holds_results(here):
            folders.clear()
            if written is not None:
                written.append(Path(place))
            continue
        out += [path for name in files if not name.startswith(".") and (path := Path(place) / name).is_file()]
    return out


def holds_results(folder: Path) -> bool:
    """Whether a folder is one of `capture`, `make`, `train` or another trainer of Gaussians, or holds
    a SOG: its pictures are copies, renders or numbers, and no photographs to find poses for."""
    if (folder / NOTE).is_file() or (folder / WORK).is_dir() or ((folder / SOURCE).is_file() and (folder / "capture").is_dir()):
        return True
    trained = (folder / POINT_CLOUD).is_dir() or (folder / CHECKPOINTS).is_dir()
    if trained and ((folder / "config.json").is_file() or (folder / "cfg_args").is_file()):
        return True
    return (folder / "meta.json").is_file() and (folder / "means_l.webp").is_file()


def tell_written(written: list[Path], folder: Path) -> str:
    """Say which folders were left out."""
    names = few(sorted(f"{path.relative_to(folder).as_posix()}/" for path in written))
    return f"left out {names}: results of a program, no photographs"
