"""A page for a web server that shows a coarse scene first and then loads the rest, part by part.

The page is that of html without its scene. Beside it, a folder has the parts as files (`layers`): a
coarse scene, a plan, and chunks, those that the first view shows first. Any server of files serves
them. The page knows the length and the checksum of each, and their names change with their content.
"""

from __future__ import annotations

import re
import zlib
from pathlib import Path
from typing import Any

from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.numbers import whole_number
from scene_experts.core.reading.source import inside, opening
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
FOLDER = ".parts"  # behind the name of the page without its suffix
MORE = 1.075  # times the bytes of a compact file, at most about
_NAME = re.compile(r"(coarse|plan|\d{2})-[0-9a-f]{8}\.bin")
_MOST_PART = 1 << 40  # bytes


def write(path: Path, contents: Layered, note: dict[str, Any]) -> str:
    """Write the parts and then the page, each atomically; parts of an older page go. Returns what
    the bytes are for. Raises as `live.write`."""
    live.expect_drawable(contents.data)
    made = layers.encode(contents.data, contents.rows, contents.coarse, contents.given)
    folder, listed = Path(path).with_suffix(FOLDER), []
    folder.mkdir(parents=True, exist_ok=True)
    for name, part in [("coarse", made.coarse), ("plan", made.plan), *((f"{i:02}", chunk) for i, chunk in enumerate(made.chunks))]:
        checksum = zlib.crc32(part)
        listed.append([f"{name}-{checksum:08x}.bin", len(part), checksum])
        write_bytes(folder / listed[-1][0], part)
    settings = live.page_settings(contents.data, note)
    settings |= {"exact": settings["exact"] or not live.fits_halves(contents.coarse), "folder": folder.name, "parts": listed}
    write_bytes(Path(path), html.make_page(GENERATOR, note, settings, b"", CODE, live.LICENCE))
    for old in folder.iterdir():
        if _NAME.fullmatch(old.name) and old.name not in {name for name, *_ in listed}:
            old.unlink()
    share = len(made.coarse) / made.size
    return f"{made.size:,} bytes in {len(listed)} parts in {folder.name}, shown after {len(made.coarse):,} of them ({share:.0%})"


def read(path: Path) -> AnchorData:
    """The scene of a page and its parts. Raises InputError for other and damaged pages, and for
    parts that are missing or damaged."""
    with opening(path, budget.HTML) as source:
        settings = html.settings_in(source.read())
        listed = [(str(name), whole_number(size, "the length of a part", 0, _MOST_PART)) for name, size, _ in settings["parts"]]
        if len(listed) < 3 or not all(_NAME.fullmatch(name) for name, _ in listed):
            raise Damaged("no list of parts")
        folder = inside(Path(path).parent, settings["folder"])
    first, plan, *chunks = [folder / name for name, _ in listed]
    with opening(first, budget.COMPACT) as source:
        base = compact.decode_whole(source.read(), source)
    with opening(plan, budget.COMPACT) as source:
        scene = layers.LayeredScene(base, source.read(), source)
    for chunk in chunks:
        with opening(chunk, budget.COMPACT) as source:
            scene.take(source.read())
    with opening(plan, budget.COMPACT):
        if scene.taken < scene.chunks:
            raise CutShort("fewer chunks than the plan has")
        return scene.restored()


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
    read=read,
    marks=(b"<!doctype html>",),
    looks_like=lambda path, head: MARK in head,
    view_note=live.view_note,
    look=live.look,
    fit=fit,
)
