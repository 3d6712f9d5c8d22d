"""The hidden folder in which a capture is made. The rest of the capture is not touched until
everything in it is complete."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable, locked, read_json
from scene_experts.data.match import is_picture

NAME, DONE, WHOLE = ".capture", "done", "whole"
FILES = "files"  # entry of capture.json: what was copied among the images
PLACES = {"images": "images", "model": "sparse/0", "capture.json": "capture.json"}
"""The results by name in the work folder's `done`, and their places in the capture."""
MODEL = tuple(f"{part}{kind}" for part in ("cameras", "images", "points3D", "frames", "rigs") for kind in (".bin", ".txt"))
"""The files of a reconstruction."""


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
    """Move the results to their places, then remove what they replace. Other files beside it, such
    as masks and lists of the user, stay. A process that is killed meanwhile is continued by the
    next call."""
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
    keep_others(folder / "old-model", out / PLACES["model"], lambda name: name in MODEL)
    made = _made(folder / "old-capture.json")
    keep_others(folder / "old-images", out / PLACES["images"], lambda name: name in made if made else is_copy(name))
    for path in folder.iterdir():
        if path.name not in (".lock", WHOLE):
            remove(path)
    (folder / WHOLE).unlink()


def keep_others(old: Path, new: Path, ours: Callable[[str], bool]) -> None:
    """Move the files that a capture did not make from `old` to `new`, where there is none of that
    name. ours: Tells a file that it made, by its path in `old`."""
    for path in sorted(old.rglob("*")) if old.is_dir() else ():
        name = path.relative_to(old).as_posix()
        if (path.is_file() or path.is_symlink()) and not ours(name) and not (new / name).exists():
            (new / name).parent.mkdir(parents=True, exist_ok=True)
            path.rename(new / name)


def is_copy(name: str) -> bool:
    """Return whether a file among the images of a capture without a list (`FILES`) counts as a copy
    of it: pictures do, but for masks."""
    return is_picture(name) and not name.lower().endswith("_mask.png")


def _made(note: Path) -> set[str]:
    """Return the files among the images that the capture of a note copied there; empty where it
    does not say."""
    try:
        found = read_json(note, "note of a capture") if note.is_file() else None
    except InputError:
        found = None
    files = found.get(FILES) if isinstance(found, dict) else None
    return {name for name in files if isinstance(name, str)} if isinstance(files, list) else set()


def remove(path: Path) -> None:
    """Remove a file or a folder if it exists."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
