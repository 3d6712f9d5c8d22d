"""Standard Gaussians to and from the file formats that other tools read: one table of formats, one writer, one reader.

Every reader takes bytes as arrays alone: nothing in a file is executed, and what a file declares is checked before memory is taken for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene_experts.errors import InputError, nearest
from scene_experts.export.comments import note_comments
from scene_experts.export.ply import read_gaussian_ply, write_gaussian_ply
from scene_experts.export.splats import Splats

Note = dict[str, Any]


@dataclass(frozen=True)
class Format:
    """One file format: `write(path, splats, note)` and, where we read it too, `read(path)`."""

    suffix: str
    about: str
    write: Callable[[Path, Splats, Note], None]
    read: Callable[[Path], Splats]


def write_ply(path: Path, splats: Splats, note: Note) -> None:
    """Write 3DGS's PLY, exact in float32; the note as a comment of its header."""
    s = splats
    write_gaussian_ply(path, s.means, s.sh, s.opacity_logit, s.log_scales, s.quats, comments=note_comments(note))


def read_ply(path: Path) -> Splats:
    """The Gaussians of 3DGS's PLY. Raises InputError for other or damaged files."""
    return Splats(**read_gaussian_ply(path))


FORMATS: dict[str, Format] = {
    "ply": Format(".ply", "3DGS's file, exact; every viewer of Gaussians reads it", write_ply, read_ply),
}


def write_standard(path: Path, splats: Splats, format: str, note: Note) -> None:
    """Write `splats` to `path` in a format of `FORMATS`, atomically.

    note: how the file was made (plain JSON values), kept where the format has room for it.
    Raises InputError for an unknown format and for values that are not finite; RunError when the disk is full.
    """
    if format not in FORMATS:
        raise InputError(f"expected a format of {', '.join(FORMATS)}, found '{format}'{nearest(format, FORMATS)}; give one of them")
    for name in ("means", "log_scales", "quats", "opacity_logit", "sh"):
        value = getattr(splats, name)
        bad = int((~value.isfinite()).reshape(len(splats), -1).any(1).sum()) if len(splats) else 0
        if bad:
            raise InputError(f"expected finite {name}, found {bad:,} Gaussians with others; make them again")
    FORMATS[format].write(Path(path), splats, note)


def read_standard(path: Path) -> Splats:
    """The Gaussians of a file in any format of `FORMATS`, known by its first bytes.

    Raises InputError: absent, of no format known here, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"expected a file of Gaussians at {path}, found none; check the path")
    return FORMATS[format_of(path)].read(path)


def format_of(path: Path) -> str:
    """The name in `FORMATS` of a file's format, by its first bytes. Raises InputError for others."""
    with path.open("rb") as stream:
        head = stream.read(4096)
    if head.startswith(b"ply"):
        return "ply"
    raise InputError(f"expected a file of {', '.join(FORMATS)} at {path}, found something else; give another file")
