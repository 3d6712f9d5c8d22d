"""The hidden folder in which a capture is made. The rest of the capture is not touched until
everything in it is complete."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scene_experts.core.io import check_writable, locked

NAME, DONE, WHOLE = ".capture", "done", "whole"
PLACES = {"images": "images", "model": "sparse/0", "capture.json": "capture.json"}
"""The results by name in the work folder's `done`, and their places in the capture."""


@contextmanager
def open_work_folder(out: Path) -> Iterator[Path]:
    """Lock the work folder of the capture `out` for this process and yield it. Complete results of
    a killed process are published first.

    After an error, folders that were made here are removed if nothing was written to them.

    Raises InputError if another process holds the lock, RunError if `out` is not writable.
    """
    folder = out / NAME
    made = [path for path in (folder, out) if not path.exists()]
    check_writable(folder / ".lock")
    with locked(folder / ".lock", f"another process is making a capture in {out}; wait until it ends"):
        if (folder / WHOLE).exists():
            publish(out)
        try:
            yield folder
        except BaseException:
            if folder in made and [path.name for path in folder.iterdir()] == [".lock"]:
                (folder / ".lock").unlink()
                with suppress(OSError):  # not empty
                    for path in made:
                        path.rmdir()
            raise


def publish(out: Path) -> None:
    """Move the results to their places, then remove what they replace. A process that is killed
    meanwhile is continued by the next call."""
    folder = out / NAME
    (folder / WHOLE).touch()
    for name, place in PLACES.items():
        new, there, old = folder / DONE / name, out / place, folder / f"old-{name}"
        if not new.exists():
            continue
        if there.exists():
            remove(old)
            there.rename(old)
        there.parent.mkdir(parents=True, exist_ok=True)
        new.rename(there)
    for path in folder.iterdir():
        if path.name not in (".lock", WHOLE):
            remove(path)
    (folder / WHOLE).unlink()


def remove(path: Path) -> None:
    """Remove a file or a folder if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
