"""A page that decodes the scene's networks in the browser, opened from disk; it fetches nothing.

The page holds the compact file of a scene of anchors and a script (tools/viewer/live) that decodes
it for the position of the camera, with WebGPU, or without it with WebGL 2. The note has the entries
that html's has, `first`, entries of cameras whose views fill screens of their aspects, `pictures`,
small photographs of the entries in `cameras` as WebP files, and `nearest`, the depth up to which
nothing is drawn. What nothing covers shows the scene's own
background: trainings leave dark things transparent before it, so that another colour would be
wrong.
"""

from __future__ import annotations

import base64
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import opening
from scene_experts.data.views import Capture, View, World
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.anchors.quality import choose_precision
from scene_experts.files.anchors.rounding import distance_exponent
from scene_experts.files.anchors.thumbnails import make_thumbnails
from scene_experts.files.cameras import camera_entries
from scene_experts.files.formats import html
from scene_experts.files.measure import Painter, Tell
from scene_experts.files.options import Options
from scene_experts.files.registry import Format
from scene_experts.files.result_folder import file_world
from scene_experts.render import Rasterizer
from scene_experts.scene.anchors.levels import Levels
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.training.run_folder import OpenRun
from scene_experts.view.filled import find_first_views
from scene_experts.view.paint import PALETTE

BAKED = "baked-html"
GENERATOR = "scene-experts live"
MARK = f'<meta name="generator" content="{GENERATOR}">'.encode()
LICENCE = "scene-experts, Apache-2.0"
CODE = "live.min.js.gz"
SPARE = 4000  # bytes for a title, first views, and numbers that are longer in the frame of the page
ROUTERS = {"Linear": "softmax", "Places": "softmax", "Margin": "margin", "Balanced": "balanced"}
"""Routers by the type in a description -> how the script weighs the experts that they choose."""
LARGEST_HALF = 60_000.0  # beyond it the script holds values in 32 bits
_KNOWN = {f"{a}.{name}" for a in ATTRIBUTES for name in ("router.weight", "router.bias", "router_balance")}
_KNOWN |= {f"{a}.experts.{name}" for a in ATTRIBUTES for name in ("w1", "b1", "w2", "b2")} | {"appearance.table"}


def write(path: Path, data: AnchorData, note: dict[str, Any]) -> str:
    """Write the page. Returns what its bytes are for. Raises InputError for scenes that the script
    cannot draw, and as `compact.write`."""
    expect_drawable(data)
    encoded, sizes = compact.encode(data)
    page, pictures = make_page(data, note, encoded), sum(4 * ((len(picture) + 2) // 3) for picture in note.get("pictures", ()))
    write_bytes(Path(path), page)
    html.forget_parts(Path(path))
    photographs = f"{pictures:,} bytes of photographs, " if pictures else ""
    return f"{len(page) - 4 * ((len(encoded) + 2) // 3) - pictures:,} bytes of page and script, {photographs}{sizes}"


def make_page(data: AnchorData, note: Mapping[str, Any], encoded: bytes) -> bytes:
    """The bytes of the page of a scene whose compact file is `encoded`."""
    return html.make_page(GENERATOR, note, page_settings(data, note), encoded, CODE, LICENCE)


def read(path: Path) -> AnchorData:
    """The scene in a page that `write` made. Raises InputError for other and damaged pages."""
    with opening(path, budget.HTML) as source:
        return compact.decode(html.scene_in(source.read()), source)


def expect_drawable(data: AnchorData) -> None:
    """Raises InputError for a scene with parts that the script does not know."""
    if found := find_unknown(data):
        raise InputError(f"expected a scene that the page's script can decode, found {found}; use --format baked-html")


def find_unknown(data: AnchorData) -> str:
    """What of a scene the script does not know; empty if it knows everything."""
    about = data.about or {}
    config = (about.get("train") or {}).get("scene") or {}
    decoder, select = config.get("decoder") or {}, (config.get("select") or {}).get("type")
    further = sorted(name for name in data.networks if name not in _KNOWN)
    mixed = any(len(data.networks[f"{a}.experts.w1"]) > 1 for a in ATTRIBUTES)
    found = ""
    if not config or "extent" not in about:
        found = "one without a description"
    elif further:
        found = "a feature bank" if "feature_bank" in further[0] else f"networks with {further[0]}"
    elif select not in ("AllAnchors", "Octree"):
        found = f"anchors that {select} selects"
    elif mixed and (decoder.get("type") != "Experts" or decoder.get("router", {}).get("type") not in ROUTERS):
        found = f"experts that {decoder.get('router', {}).get('type', decoder.get('type'))} chooses"
    return found


def page_settings(data: AnchorData, note: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of the script: `html.view_settings`, and how to decode what the file holds."""
    about, places = data.about or {}, data.columns["xyz"].double()
    config = about["train"]["scene"]
    centre = places.median(0).values if len(places) else torch.zeros(3, dtype=torch.float64)
    view = html.view_settings(places - centre, note, centre)
    for name in ("near", "far"):
        del view[name]
    pictures = note.get("pictures") or [b""] * len(view["poses"])
    return {
        "count": len(places) * about["K"],
        "centre": centre.tolist(),
        "origin": [float(v) for v in about.get("origin", (0.0, 0.0, 0.0))],
        **view,
        "poses": [pose | _picture(picture) for pose, picture in zip(view["poses"], pictures)],
        "first": [html.pose_of(entry, centre) for entry in note.get("first") or []],
        "nearest": float(note.get("nearest") or view["distance"] / 500),
        "background": [float(v) for v in note.get("background", (0.0, 0.0, 0.0))],
        "antialias": about["train"].get("antialias") is True,
        "heads": {a: _head(a, data) for a in ATTRIBUTES},
        "experts": _palette(data),
        "router": _positions(about, centre),
        "levels": _levels(about),
        "smoothing": float(config.get("smoothing", 0.0)) if "interval" in data.columns else 0.0,
        "exact": not fits_halves(data),
    }


def _picture(picture: bytes) -> dict[str, str]:
    """The entry of a pose whose photograph is in the page."""
    return {"picture": f"data:image/webp;base64,{base64.b64encode(picture).decode()}"} if picture else {}


def _head(attribute: str, data: AnchorData) -> dict[str, Any]:
    """How the experts of an attribute are chosen: `k` of them, or `alone` one for all anchors."""
    about, networks = data.about or {}, data.networks
    experts, k = len(networks[f"{attribute}.experts.w1"]), about["k"][attribute]
    router = about["train"]["scene"]["decoder"].get("router", {})
    exponent = distance_exponent(data) if attribute in data.add_dist else 0
    return {
        "k": k or experts,
        "alone": 0 if experts == 1 or (k is None and router.get("type") == "Places") else None,
        "weigh": ROUTERS.get(router.get("type", ""), "softmax") if k else "softmax",
        "position": f"{attribute}.router.weight" in networks and networks[f"{attribute}.router.weight"].shape[1] > about["F"],
        "distance": 2.0**exponent,
    }


def _palette(data: AnchorData) -> list[tuple[float, float, float]] | None:
    """The colours of the experts that anchors have; None for one network, and for more than there are
    colours."""
    for attribute in reversed(ATTRIBUTES):
        if _head(attribute, data)["alone"] is None:
            count = len(data.networks[f"{attribute}.experts.w1"])
            return list(PALETTE[:count]) if count <= len(PALETTE) else None
    return None


def _positions(about: dict[str, Any], centre: Tensor) -> dict[str, Any]:
    """What routers see of a position relative to `centre` [3]: it times `scale`, plus `shift`."""
    world, extent = file_world(about), float(about["extent"])
    return {"scale": world.scale / extent, "shift": (world.from_input(centre) / extent).tolist()}


def _levels(about: Mapping[str, Any]) -> dict[str, Any] | None:
    """The levels of detail, in the unit of the file: edges of their cells, coarse to fine."""
    if "levels" not in about.get("scene", {}):
        return None
    levels, scale = Levels.from_meta(about["scene"]["levels"]), float(about["world"]["scale"])
    edges = [levels.size(j) / scale for j in range(levels.count)]
    return {"edges": edges, "standard": levels.standard / scale, "fork": levels.fork, "rule": levels.rule}


def fits_halves(data: AnchorData) -> bool:
    """Whether 16 bits hold the values of a scene; sizes are held relative to their median."""
    values = [data.columns["feature"], data.columns["offsets"], *data.networks.values()]
    sizes = data.columns["log_scaling"]
    spread = float(sizes.max() - sizes.median()) if sizes.numel() else 0.0
    return all(float(value.abs().max()) < LARGEST_HALF for value in values if value.numel()) and spread < 10


def view_note(capture: Capture, world: World) -> dict[str, Any]:
    """html's entries and the near plane. See `html.view_note`."""
    near = {"nearest": capture.views[0].camera.near / world.scale} if capture.views else {}
    return html.view_note(capture, world) | near


def look(run: OpenRun, capture: Capture, world: World, options: Options, rasterize: Rasterizer | None) -> dict[str, Any]:
    """The entries `first` and `pictures` of a note. See `registry.Format.look`, `view.filled` and
    `thumbnails`."""
    pictures = {"pictures": make_thumbnails(capture)} if options.photographs else {}
    painter, black = Painter.of(run.scene, run.step, rasterize, run.config.train.antialias), torch.zeros(3)
    found = find_first_views(capture, lambda camera: painter.rasterize(painter.gaussians(camera), camera, black))
    return {"first": camera_entries([View("first", view.camera, Path()) for view in found], world), **pictures}


def fit(
    run: OpenRun,
    contents: AnchorData,
    world: World,
    options: Options,
    capture: Capture | None,
    rasterize: Rasterizer | None,
    tell: Tell,
) -> tuple[AnchorData, list[str]]:
    """See `registry.Format.fit`; `target_mb` is the size of the whole page."""
    expect_drawable(contents)

    note = {} if capture is None or options.target_mb == 0 else view_note(capture, world)
    pictures = make_thumbnails(capture) if options.photographs and options.target_mb and capture is not None else []
    spare = SPARE + sum(4 * ((len(picture) + 2) // 3) + 3 for picture in pictures)

    def size(data: AnchorData) -> int:
        return spare + len(make_page(data, note, compact.encode(data)[0]))

    return choose_precision(run, contents, world, options, capture, rasterize, tell, size)


FORMAT = Format(
    suffix=".html",
    family="anchors",
    write=write,
    read=read,
    marks=(b"<!doctype html>",),
    looks_like=lambda path, head: MARK in head,
    view_note=view_note,
    look=look,
    fit=fit,
    otherwise=BAKED,
    lacks=find_unknown,
)
