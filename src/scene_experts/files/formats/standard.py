"""Standard Gaussians to and from the file formats that other tools read: one table of formats, one writer, one reader.

Every reader takes bytes as arrays alone: nothing in a file is executed, and what a file declares is checked before memory is taken for it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.errors import InputError, nearest
from scene_experts.files.formats.comments import note_comments
from scene_experts.files.formats.compressed_ply import read_compressed_ply, write_compressed_ply
from scene_experts.files.formats.gltf import read_glb, write_glb
from scene_experts.files.formats.html_page import MARK, PAGE_NOTES, read_html, write_html
from scene_experts.files.formats.sog import read_sog, write_sog
from scene_experts.files.formats.splat_file import ROW, read_splat, write_splat
from scene_experts.files.formats.splats import Splats
from scene_experts.files.formats.spz import read_spz, write_spz
from scene_experts.files.ply import HEADER_LIMIT, read_gaussian_ply, write_gaussian_ply

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
    "compressed-ply": Format(".compressed.ply", "SuperSplat's PLY, 16 - 61 bytes a Gaussian", write_compressed_ply, read_compressed_ply),
    "splat": Format(".splat", "32 bytes a Gaussian, no harmonics; the oldest web viewers read it", write_splat, read_splat),
    "spz": Format(".spz", "Niantic's, small; phones and glTF tools read it", write_spz, read_spz),
    "sog": Format(".sog", "PlayCanvas's, the smallest", write_sog, read_sog),
    "glb": Format(".glb", "glTF with KHR_gaussian_splatting, exact", write_glb, read_glb),
    "html": Format(".html", "a page that shows the scene, opened from disk in any browser", write_html, read_html),
}

_MARKS: dict[str, tuple[bytes, ...]] = {"spz": (b"\x1f\x8b", b"NGSP"), "sog": (b"PK\x03\x04",), "glb": (b"glTF",)}


def write_standard(path: Path, splats: Splats, format: str, note: Note) -> None:
    """Write `splats` to `path` in a format of `FORMATS`, atomically.

    note: how the file was made (plain JSON values), kept where the format has room for it. What a page shows beside the scene (camera,
    cameras, background, antialias, title: see `html_page`) is for html alone, `antialias` for spz too.
    Raises InputError for an unknown format and for values that are not finite; RunError when the disk is full.
    """
    if format not in FORMATS:
        raise InputError(f"expected a format of {', '.join(FORMATS)}, found '{format}'{nearest(format, FORMATS)}; give one of them")
    for name in ("means", "log_scales", "quats", "opacity_logit", "sh"):
        value = getattr(splats, name)
        bad = int((~value.isfinite()).reshape(len(splats), -1).any(1).sum()) if len(splats) else 0
        if bad:
            raise InputError(f"expected finite {name}, found {bad:,} Gaussians with others; make them again")
    kept = note if format in ("html", "spz") else {name: value for name, value in note.items() if name not in PAGE_NOTES}
    FORMATS[format].write(Path(path), splats, kept)


def read_standard(path: Path) -> Splats:
    """The Gaussians of a file in any format of `FORMATS`, known by its first bytes; .splat, which has no mark, by its name or size.

    Raises InputError: absent, of no format known here, or damaged.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"expected a file of Gaussians at {path}, found none; check the path")
    return FORMATS[format_of(path)].read(path)


def format_of(path: Path) -> str:
    """The name in `FORMATS` of a file's format, by its first bytes. Raises InputError for others.

    A .splat file has no mark: what starts like no other and is so called, or is whole rows of numbers that make sense, is one.
    """
    with path.open("rb") as stream:
        head = stream.read(4096)
    if head.startswith(b"ply"):
        return "compressed-ply" if b"\nelement chunk " in _ply_header(path) else "ply"
    for name, marks in _MARKS.items():
        if head.startswith(marks):
            return name
    if MARK in head:
        return "html"
    if path.suffix.lower() == ".splat" or _like_splat(head, path.stat().st_size):
        return "splat"
    raise InputError(f"expected a file of {', '.join(FORMATS)} at {path}, found something else; give another file")


def _ply_header(path: Path) -> bytes:
    with path.open("rb") as stream:
        return stream.read(HEADER_LIMIT).split(b"\nend_header", 1)[0]


def _like_splat(head: bytes, size: int) -> bool:
    """Whether the first rows hold positions and lengths such as a .splat file's."""
    if size == 0 or size % ROW.itemsize:
        return False
    rows = np.frombuffer(head[: len(head) // ROW.itemsize * ROW.itemsize], ROW)
    lengths = rows["scales"]
    sane = np.isfinite(rows["means"]) & (np.abs(rows["means"]) < 1e6) & (lengths > 1e-12) & (lengths < 1e6)
    return bool(sane.all())
