"""A page for a web server that shows a coarse scene first and then loads the rest, part by part.

The page is that of html without its scene. Beside it, a folder has the parts as files (`layers`): a
coarse scene, a plan, and chunks, those that the first view shows first. Any server of files serves
them. The page knows the length and the checksum of each, and their names change with their content.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.numbers import whole_number
from scene_experts.core.reading.source import Source, inside, opening
from scene_experts.data.views import Capture, World
from scene_experts.files.anchors import compact, layers, live
from scene_experts.files.anchors.coarse import Layered, make_layers
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.quality import choose_precision, judging_capture
from scene_experts.files.formats import html
from scene_experts.files.measure import Tell
from scene_experts.files.options import Options
from scene_experts.files.registry import Format
from scene_experts.files.scene_folder import origin_of
from scene_experts.render import Rasterizer
from scene_experts.training.run_folder import OpenRun

GENERATOR = "scene-experts streamed"
MARK = f'<meta name="generator" content="{GENERATOR}">'.encode()
CODE = "streamed.min.js.gz"
MORE = 1.075  # times the bytes of a compact file, at most about
_MOST_PART = 1 << 40  # bytes
_SUM = 4  # bytes of the CRC-32 that every part ends in


def write(path: Path, contents: Layered, note: dict[str, Any]) -> str:
    """Write the parts and then the page, each atomically; parts of an older page go. Returns what
    the bytes are for. Raises as `live.write`."""
    live.expect_drawable(contents.data)
    made = layers.encode(contents.data, contents.rows, contents.coarse, contents.given)
    folder, listed = Path(path).with_suffix(html.PARTS), []
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in [("coarse", made.coarse), ("plan", made.plan), *((f"{i:02}", chunk) for i, chunk in enumerate(made.chunks))]:
        checksum = _checksum(part)
        listed.append([f"{name}-{checksum:08x}.bin", len(part), checksum])
        write_bytes(folder / listed[-1][0], part)
    settings = live.page_settings(contents.data, note)
    settings |= {"exact": settings["exact"] or not live.fits_halves(contents.coarse), "folder": folder.name, "parts": listed}
    write_bytes(Path(path), html.make_page(GENERATOR, note, settings, b"", CODE, live.LICENCE))
    for old in folder.iterdir():
        if html.PART_NAME.fullmatch(old.name) and old.name not in {name for name, *_ in listed}:
            old.unlink()
    page, share = Path(path).stat().st_size, len(made.coarse) / made.size
    return f"page {page / 1e6:.2f}, {len(listed)} parts {made.size / 1e6:.2f} in {folder.name}, shown after {share:.0%} of them"


def size(path: Path) -> int:
    """The bytes of a page that `write` has just made, and of its parts."""
    parts = [part for part in Path(path).with_suffix(html.PARTS).iterdir() if html.PART_NAME.fullmatch(part.name)]
    return sum(file.stat().st_size for file in (Path(path), *parts))


def read(path: Path) -> AnchorData:
    """The scene of a page and its parts. Raises InputError for other and damaged pages, and for
    parts that are missing or damaged."""
    with opening(path, budget.HTML) as source:
        settings = html.settings_in(source.read())
        listed = [_Part.listed(*entry) for entry in settings["parts"]]
        if len(listed) < 3:
            raise Damaged("no list of parts")
        folder = inside(Path(path).parent, settings["folder"])
    first, plan, *chunks = listed
    with opening(folder / first.name, budget.COMPACT) as source:
        base = compact.decode_whole(first.read(source, path), source)
    with opening(folder / plan.name, budget.COMPACT) as source:
        scene = layers.LayeredScene(base, plan.read(source, path), source)
    for chunk in chunks:
        with opening(folder / chunk.name, budget.COMPACT) as source:
            scene.take(chunk.read(source, path))
    with opening(folder / plan.name, budget.COMPACT):
        if scene.taken < scene.chunks:
            raise CutShort("fewer chunks than the plan has")
        return scene.restored()


@dataclass(frozen=True)
class _Part:
    """A part as its page lists it."""

    name: str
    size: int
    checksum: int

    @classmethod
    def listed(cls, name: Any, size: Any, checksum: Any) -> _Part:
        """Raises Damaged for an entry that `write` does not make."""
        if not isinstance(name, str) or not html.PART_NAME.fullmatch(name):
            raise Damaged("no list of parts")
        size = whole_number(size, "the length of a part", 0, _MOST_PART)
        return cls(name, size, whole_number(checksum, "a checksum", 0, 0xFFFFFFFF))

    def read(self, source: Source, page: Path) -> bytes:
        """The bytes of the part. Raises InputError for others than the page lists."""
        found = source.read()
        last = int.from_bytes(found[-_SUM:], "little")
        if len(found) == self.size and last == _checksum(found) == self.checksum:
            return found
        other = "another checksum" if len(found) == self.size else f"{len(found):,} bytes in place of {self.size:,}"
        raise InputError(
            f"expected the part of {page} that it lists at {source.path}, found {other}, so it belongs to another export or is damaged; "
            "copy the page and its folder of parts again, or export the run again"
        )


def _checksum(part: bytes) -> int:
    """The CRC-32 of the bytes before the last 4, which are that checksum already. The CRC-32 of all
    bytes would be the same number for every part."""
    return zlib.crc32(part[:-_SUM])


def fit(
    run: OpenRun,
    contents: AnchorData,
    world: World,
    options: Options,
    capture: Capture | None,
    rasterize: Rasterizer | None,
    tell: Tell,
) -> tuple[Layered, list[str]]:
    """See `registry.Format.fit`; `target_mb` is the size of the parts."""
    live.expect_drawable(contents)
    data, lines = choose_precision(
        run, contents, world, options, capture, rasterize, tell, lambda data: round(MORE * compact.encode(data)[1].total)
    )
    with judging_capture(run, world, capture) as views:
        return make_layers(run, data, world.seen_from(origin_of(run, world)), views, rasterize, tell), lines


FORMAT = Format(
    suffix=".html",
    family="anchors",
    write=write,
    size=size,
    read=read,
    marks=(b"<!doctype html>",),
    looks_like=lambda path, head: MARK in head,
    view_note=live.view_note,
    look=live.look,
    fit=fit,
)
