"""A zip archive that holds one scene in another format."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.core.reading import budget
from scene_experts.core.reading.archives import open_zip
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.source import opening, shorten
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import GAUSSIANS, Format, Note, recognise

SCENES = (".ply", ".splat", ".ksplat", ".spz", ".sog", ".glb")
_PLAIN = ("ply", "splat", "ksplat")  # formats that a zip makes much smaller; others take more memory per byte
_MOST, _SMALL = 1.5, 1 << 16  # how much smaller a zip makes those others, and the bytes for which that does not matter
_UNPACK = "unpack it and give the file or folder of the scene"


def read(path: Path) -> Splats:
    """The Gaussians of the one scene in a zip. Raises InputError for a zip with no or several
    scenes, and for damaged ones."""
    with _unpacked(path) as (inner, format):
        assert format.read is not None
        found: Splats = format.read(inner)
        return found


def is_antialiased(path: Path) -> bool:
    """Whether the scene in a zip says that it is drawn with antialiasing. Raises InputError as
    `read` does."""
    with _unpacked(path) as (inner, format):
        return format.is_antialiased is not None and format.is_antialiased(inner)


def read_note(path: Path) -> Note:
    """The note of the scene in a zip. Raises InputError as `read` does."""
    with _unpacked(path) as (inner, format):
        return {} if format.read_note is None else format.read_note(inner)


@contextmanager
def _unpacked(path: Path) -> Iterator[tuple[Path, Format]]:
    """The scene of a zip as a file, for as long as the block lasts, and its format. Errors name the
    zip."""
    with (
        opening(path, budget.ZIP) as source,
        open_zip(source) as archive,
        tempfile.TemporaryDirectory(prefix="scene-experts-zip-") as folder,
    ):
        visible = [name for name in archive.names if not name.startswith("__MACOSX/") and not name.endswith("/")]
        names = [name for name in visible if name.lower().endswith(SCENES)]
        names = [name for name in names if name.endswith("point_cloud.ply")] or names  # beside the points of a result folder
        if len(names) != 1:
            shown = ", ".join(shorten(name, 40) for name in (names or visible)[:3])
            count = f"{len(names):,} among {len(visible):,} files"
            raise InputError(f"expected one scene ({', '.join(SCENES)}) in {path}, found {count} ({shown}); {_UNPACK}")
        base = names[0].rpartition("/")[2]
        inner = Path(folder) / path.name / (base if re.fullmatch(r"[\w() -][\w.() -]{0,99}", base) else f"scene{Path(base).suffix}")
        inner.parent.mkdir()  # named after the zip, for the warnings of readers
        archive.unpack(names[0], inner)
        try:
            name, format = recognise(inner)
            if name not in _PLAIN and inner.stat().st_size > _MOST * source.size + _SMALL:
                raise Damaged(f"{source.size:,} bytes that unpack to {inner.stat().st_size:,} of {base}")
            if format.family != GAUSSIANS or format is FORMAT:
                raise InputError(f"expected Gaussians in {inner}, found another kind of file; {_UNPACK}")
            yield inner, format
        except InputError as error:
            raise InputError(str(error).replace(str(inner), f"{path} ({base})")) from error


FORMAT = Format(suffix=".zip", read=read, marks=(b"PK\x03\x04",), is_antialiased=is_antialiased, read_note=read_note)
