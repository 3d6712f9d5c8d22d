"""A page that shows the scene in any browser, opened from disk; it fetches nothing.

Renderer, scene and start pose are in one file. The renderer is Spark on three.js (MIT), bundled by
tools/viewer; the scene is an SPZ file in base64, in a unit that suits its sizes. The note may set
the start: `camera`, an entry as in cameras.json (position, rotation as rows of the 3x3
camera-to-world matrix, and fov in degrees or fy and height; width is optional), `cameras`, a list
of such entries to step through, `flight`, a closed path of such entries, `background` (RGB in [0,
1]), `antialias`, `title`, and `origin`, the place in the capture's frame that the entries are
relative to.
"""

from __future__ import annotations

import base64
import html as markup
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import CutShort, Damaged
from scene_experts.core.reading.numbers import FARTHEST as LARGEST
from scene_experts.core.reading.numbers import number
from scene_experts.core.reading.plain import parse_json
from scene_experts.core.reading.source import opening
from scene_experts.data.views import Capture, View, World
from scene_experts.files.cameras import camera_entries
from scene_experts.files.formats.pack import Floats, scaled
from scene_experts.files.formats.splats import Splats
from scene_experts.files.formats.spz import FARTHEST, decode, out_of_range, size_warning, spz_bytes
from scene_experts.files.registry import Format
from scene_experts.geometry.rotation import estimate_up
from scene_experts.view.paths import choose_best_view, make_round
from scene_experts.view.region import find_region

ASSETS = files("scene_experts.files.formats") / "assets"
MARK = b'<meta name="generator" content="scene-experts">'
_SCENE, _SETTINGS = b'<script type="text/plain" id="scene">', b'<script type="application/json" id="settings">'
_MOST = 60  # the unit of the scene lies within 2 to the power of this
_HARMLESS = 0.01  # share of Gaussians whose clipped sizes nobody sees
PARTS = ".parts"  # the folder of a streamed page: behind its name without its suffix
PART_NAME = re.compile(r"(coarse|plan|\d{2})-[0-9a-f]{8}\.bin")
FLIGHT = 48  # poses of the flight, between which the page interpolates
_FOV = 50.0  # degrees, without a camera
Pose = dict[str, Any]


def write(path: Path, splats: Splats, note: dict[str, Any]) -> str | None:
    """Write the page. Returns a warning where it cannot hold the sizes of many Gaussians, or None.
    Raises InputError for invalid cameras in the note."""
    centre = splats.means.double().median(0).values if len(splats) else torch.zeros(3, dtype=torch.float64)
    splats = replace(splats, means=(splats.means.double() - centre).float())
    settings, scene = page_settings(splats, note, centre), scaled(splats, unit_of(splats))
    licences = (ASSETS / "LICENCES.txt").read_text()
    write_bytes(path, make_page("scene-experts", note, settings, spz_bytes(scene), "viewer.min.js.gz", licences))
    forget_parts(path)
    clipped = float(out_of_range(scene).float().mean()) if len(scene) else 0.0
    return size_warning(scene) if clipped > _HARMLESS else None


def forget_parts(path: Path) -> None:
    """Remove the parts of a streamed page that a page with everything in it has replaced."""
    folder = path.with_suffix(PARTS)
    for part in folder.iterdir() if folder.is_dir() else ():
        if PART_NAME.fullmatch(part.name):
            part.unlink()
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()


def make_page(generator: str, note: Mapping[str, Any], settings: Mapping[str, Any], scene: bytes, code: str, licences: str) -> bytes:
    """The bytes of a page. generator: by which readers know it; scene: a file; code: the name of the
    compressed script among the assets; licences: of what is in the script."""
    page = Template((ASSETS / "page.html").read_text()).substitute(
        generator=generator,
        title=markup.escape(str(note.get("title", "scene-experts"))),
        licences=licences.replace("--", "- -"),
        count=f"{settings['count']:,}",
        settings=json.dumps(settings, allow_nan=False).replace("</", "<\\/"),
        scene=base64.b64encode(scene).decode(),
        code=base64.b64encode((ASSETS / code).read_bytes()).decode(),
    )
    return page.encode()


def read(path: Path) -> Splats:
    """The Gaussians in a page that `write` made. Raises InputError for other and damaged pages."""
    with opening(path, budget.HTML) as source:
        page = source.read()
        scene = scene_in(page)
        settings = _settings(page)
        unit, centre = settings.get("unit", 1.0), settings.get("centre", [0.0, 0.0, 0.0])  # older pages have none
        number(unit, "the unit of lengths", 2.0**-_MOST, 2.0**_MOST)
        if not isinstance(centre, list) or len(centre) != 3:
            raise Damaged("a centre of another form")
        place = torch.tensor([number(value, "the centre", -LARGEST, LARGEST) for value in centre], dtype=torch.float64)
        found = scaled(decode(scene, source), 1 / unit)
        return replace(found, means=(found.means.double() + place).float()).checked(path)


def scene_in(page: bytes) -> bytes:
    """The file in a page. Raises CutShort and Damaged for a page without one."""
    content = _script(page, _SCENE)
    if content is None:
        raise CutShort("no scene")
    try:
        return base64.b64decode(content, validate=True)
    except ValueError:
        raise Damaged("a scene that is not base64") from None


def settings_in(page: bytes) -> dict[str, Any]:
    """The settings in a page. Raises CutShort for a page without them, ValueError for damaged ones."""
    found = _settings(page)
    if not found:
        raise CutShort("no settings")
    return found


def unit_of(splats: Splats) -> float:
    """The factor by which the page multiplies lengths: 1 where SPZ holds every size and position,
    else the power of two that brings the median size to the middle of its range, without a position
    beyond it."""
    reach = float(splats.means.abs().max()) if len(splats) else 0.0
    if reach < FARTHEST and not out_of_range(splats).any():
        return 1.0
    middle = (-2 - float(splats.log_scales.amax(1).median())) / math.log(2)
    highest = math.floor(math.log2(FARTHEST / max(reach, 1e-30))) - 1
    return 2.0 ** max(-_MOST, min(round(middle), highest, _MOST))


def is_antialiased(path: Path) -> bool:
    """Whether the settings of a page say that it is drawn with antialiasing. Raises InputError for
    damaged settings."""
    with opening(path, budget.HTML) as source:
        return _settings(source.read()).get("antialias") is True


def _settings(page: bytes) -> dict[str, Any]:
    """The settings of a page; empty for a page without. Raises ValueError for damaged ones."""
    content = _script(page, _SETTINGS)
    if content is None:
        return {}
    settings = parse_json(content, budget.JSON)
    if not isinstance(settings, dict):
        raise Damaged("settings that are not an object")
    return settings


def _script(page: bytes, tag: bytes) -> bytes | None:
    """The content of the script that begins with `tag`; None if the page has none or ends in it."""
    start = page.find(tag) + len(tag)
    end = page.find(b"</script>", start)
    return None if start < len(tag) or end < 0 else page[start:end]


def view_note(capture: Capture, world: World) -> dict[str, Any]:
    """The entries of a note that the page uses: start at the view that shows the scene best, step
    through all, over the capture's background.

    world: the frame that the Gaussians are written in.
    """
    entries = camera_entries(capture.views, world)
    flight = make_round(capture, FLIGHT).cameras
    moves = any(not torch.equal(camera.world_to_cam, flight[0].world_to_cam) for camera in flight)  # not from one photograph
    return {
        "camera": entries[choose_best_view(capture)] if entries else None,
        "cameras": entries,
        "background": list(capture.background),
        "title": f"{capture.name}, a scene by scene-experts",
        "flight": camera_entries([View("flight", camera, Path()) for camera in flight], world) if moves else [],
    }


def page_settings(splats: Splats, note: Mapping[str, Any], centre: Tensor | None = None) -> dict[str, Any]:
    """The settings of the page's script: those of `view_settings`, the unit of lengths and the way
    to draw.

    splats: Relative to `centre` [3], a place in the frame of the note; None: its origin.
    """
    centre = torch.zeros(3, dtype=torch.float64) if centre is None else centre
    return {
        "count": len(splats),
        "unit": unit_of(splats),
        "centre": centre.tolist(),
        "origin": [float(v) for v in note.get("origin", (0.0, 0.0, 0.0))],
        **view_settings(splats.means, note, centre),
        "background": [float(v) for v in note.get("background", (0.0, 0.0, 0.0))],
        "antialias": bool(note.get("antialias", False)),
    }


def view_settings(places: Tensor, note: Mapping[str, Any], centre: Tensor) -> dict[str, Any]:
    """Poses, up direction and distances. The camera stays within `reach` of the poses; None does
    not limit it.

    places: [N, 3] where the scene is, relative to `centre` [3], a place in the frame of the note.
    """
    means = places.double().numpy()
    poses = [pose_of(entry, centre) for entry in note.get("cameras") or []]
    first = pose_of(note["camera"], centre) if note.get("camera") else poses[0] if poses else _from_outside(means)
    poses = poses or [first]
    up = estimate_up(torch.tensor([pose["rotation"] for pose in poses], dtype=torch.float64))
    distance = _distance(means, first)
    positions = torch.tensor([pose["position"] for pose in poses], dtype=torch.float64)
    return {
        "pose": first,
        "poses": poses,
        "flight": [pose_of(entry, centre) for entry in note.get("flight") or []],
        "index": poses.index(first) if first in poses else 0,
        "fov": first["fov"],
        "up": up.tolist(),
        "distance": distance,
        "reach": find_region(positions, distance).radius if note.get("cameras") else None,
        "near": distance / 500,
        "far": max(distance * 1000, 4 * _radius(means)),
        "speed": distance / 2,
    }


def pose_of(entry: Mapping[str, Any], centre: Tensor) -> Pose:
    """The pose of an entry of the note, relative to `centre` [3]. Raises InputError for an invalid one."""
    try:
        position = np.array(entry["position"], np.float64).reshape(3) - centre.numpy()
        rotation = np.array(entry["rotation"], np.float64).reshape(3, 3)
        fov = float(entry["fov"]) if "fov" in entry else math.degrees(2 * math.atan(entry["height"] / (2 * entry["fy"])))
        if not (np.isfinite(position).all() and np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3) and 0 < fov < 180):
            raise ValueError("its rotation is invalid, or its field of view is not between 0 and 180 degrees")
    except (KeyError, TypeError, ValueError, ZeroDivisionError) as error:
        raise InputError(
            f"expected cameras with position, rotation and fov (or fy and height) for the page, found one without ({error}); correct it"
        ) from None
    aspect = {"aspect": entry["width"] / entry["height"]} if entry.get("width") and entry.get("height") else {}
    return {"position": position.tolist(), "rotation": rotation.tolist(), "fov": fov, **aspect}


def _from_outside(means: Floats) -> Pose:
    """A pose that sees the whole scene."""
    centre = np.median(means, 0) if len(means) else np.zeros(3)
    away = 1.5 * _radius(means) / math.tan(math.radians(_FOV / 2))
    return {"position": (centre - [0, 0, away]).tolist(), "rotation": np.eye(3).tolist(), "fov": _FOV}


def _radius(means: Floats) -> float:
    """Radius of the ball around the median position that holds 90 % of the Gaussians."""
    if not len(means):
        return 1.0
    return max(float(np.quantile(np.linalg.norm(means - np.median(means, 0), axis=1), 0.9)), 1e-6)


def _distance(means: Floats, pose: Pose) -> float:
    """Distance from the camera to the scene: the median depth of the Gaussians near its axis."""
    local = (means - pose["position"]) @ np.array(pose["rotation"])
    ahead = local[(local[:, 2] > 0) & (np.abs(local[:, :2]).max(1, initial=0.0) < 0.3 * local[:, 2])]
    return float(np.median(ahead[:, 2])) if len(ahead) else 2 * _radius(means)


FORMAT = Format(
    suffix=".html",
    write=write,
    read=read,
    marks=(b"<!doctype html>",),
    looks_like=lambda path, head: MARK in head,
    antialias=True,
    is_antialiased=is_antialiased,
    view_note=view_note,
)
