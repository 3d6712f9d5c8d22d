"""Where a capture is in the making: a hidden folder of its own. Nothing else of the capture is touched before all of it is done."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene_experts.core.io import check_writable, locked

NAME, DONE, WHOLE = ".capture", "done", "whole"
PLACES = {"images": "images", "model": "sparse/0", "capture.json": "capture.json"}
"""What is made, by its name in the work folder's `done`, and its place in the capture."""


@contextmanager
def opened(out: Path) -> Iterator[Path]:
    """The work folder of capture `out`, held for this process; what a killed one had made whole is put in its place first.

    Raises InputError where another process is at it, RunError where `out` cannot be written.
    """
    work = out / NAME
    check_writable(work / ".lock")
    with locked(work / ".lock", f"expected {out} for this capture alone, found another process making one there; wait for it"):
        if (work / WHOLE).exists():
            publish(out)
        yield work


def publish(out: Path) -> None:
    """Move what is done to its place; what was there goes once all has moved. Killed at any moment, it goes on where it was."""
    work = out / NAME
    (work / WHOLE).touch()
    for name, place in PLACES.items():
        new, there, old = work / DONE / name, out / place, work / f"old-{name}"
        if not new.exists():
            continue
        if there.exists():
            remove(old)
            there.rename(old)
        there.parent.mkdir(parents=True, exist_ok=True)
        new.rename(there)
    for path in work.iterdir():
        if path.name not in (".lock", WHOLE):
            remove(path)
    (work / WHOLE).unlink()


def remove(path: Path) -> None:
    """Remove a file or a folder, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
