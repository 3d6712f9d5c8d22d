"""How much of the screen the first view of a page fills, drawn by our own rasteriser.

    python benchmarks/first_view.py RUN [PAGE]

PAGE is a page that `export RUN --format html` wrote; without one, first views are chosen anew. A
pixel is opaque where its opacity is at least 0.95, and seen where three training photographs saw
what it shows (a point is hidden 10 % behind the depth that a photograph's place sees); it is filled
where it is both. "areas" are pixels of a 96th of a photograph's
shorter side, which show holes; "pixels" have the size of the photographs' pixels in training, where
the gaps between Gaussians count too. The last line is
the mean of the photographs' own views. "before" is the view of the best photograph's place as pages
showed it when there were no first views.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from scene_experts.core.types import Camera
from scene_experts.data.views import World
from scene_experts.files.anchors import live
from scene_experts.files.measure import Painter, capture_if_there
from scene_experts.files.options import DEFAULT
from scene_experts.files.scene_folder import world_of
from scene_experts.geometry.poses import make_pose, with_fov
from scene_experts.training.run_folder import open_run
from scene_experts.view.filled import OPAQUE, Evidence, small

SCREENS = {"16:9": (960, 540), "4:3": (800, 600), "9:19": (360, 760)}
COLUMNS = ("areas", "opaque", "seen", "filled")
MOST = 12  # photographs whose own views are judged
SIDE = 256  # px of the shorter side, of the pictures at the photographs' places


def tangent_on(entry: Mapping[str, Any], aspect: float, fills: bool) -> float:
    """The tangent of half the height that the page shows of a pose (tools/viewer/live/page.js: fit)."""
    ratio = entry["width"] / entry["height"] / aspect
    return entry["height"] / (2 * entry["fy"]) * (ratio if ratio < 1 else 1.0 if fills else math.sqrt(ratio))


def camera_of(entry: Mapping[str, Any], up: float, size: tuple[int, int], world: World, model: Camera) -> Camera:
    """The camera of an entry in the trained world, with a vertical field of view."""
    rotation = torch.tensor(entry["rotation"], dtype=torch.float64)
    place = world.from_input(torch.tensor(entry["position"], dtype=torch.float64))
    return with_fov(replace(model, world_to_cam=make_pose(place, rotation).float()), 2 * math.atan(up), *size)


def first_entries(page: Path) -> list[dict[str, Any]]:
    """The first views of a page as entries of a note."""
    settings = json.loads(re.search(rb'id="settings">(.*?)</script>', page.read_bytes(), re.DOTALL)[1])  # type: ignore[index]
    out = []
    for pose in settings["first"]:
        place = [sum(parts) for parts in zip(pose["position"], settings["centre"], settings["origin"])]
        fy = 500 / math.tan(math.radians(pose["fov"] / 2))
        out.append({"position": place, "rotation": pose["rotation"], "fy": fy, "height": 1000, "width": 1000 * pose["aspect"]})
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("run", type=Path)
    parser.add_argument("page", type=Path, nargs="?")
    args = parser.parse_args()
    run = open_run(args.run)
    with capture_if_there(run, needed=True) as capture, torch.no_grad():
        assert capture is not None
        world, painter = world_of(run), Painter.of(run.scene, run.step, None, run.config.train.antialias)

        def draw(camera: Camera) -> Any:
            return painter.rasterize(painter.gaussians(camera), camera, torch.zeros(3))

        evidence = Evidence.of(capture, draw, most=len(capture.views), side=SIDE)
        model, note = capture.views[0].camera, live.view_note(capture, world)
        first = first_entries(args.page) if args.page else live.look(run, capture, world, DEFAULT, None)["first"]

        def shares(camera: Camera) -> dict[str, float]:
            """The shares of a picture's areas that are filled, and of its pixels that are opaque, seen and filled."""
            coarse = small(camera, max(1, round(96 / min(model.width, model.height) * min(camera.width, camera.height))))
            areas = evidence.covered(coarse, draw(coarse))
            picture = draw(camera)
            filled, opaque = evidence.covered(camera, picture), picture.alpha >= OPAQUE
            seen = evidence.covered(
                camera, replace(picture, alpha=torch.ones_like(picture.alpha), depth=picture.depth / picture.alpha.clamp_min(1e-6))
            )
            return {
                name: 100 * float(t.double().mean())
                for name, t in zip(("areas", "opaque", "seen", "filled"), (areas, opaque, seen, filled))
            }

        def judge(entry: Mapping[str, Any], aspect: float, fills: bool) -> tuple[dict[str, float], float]:
            """The shares, and the larger share of the best photograph's width and height in view."""
            up, photograph = tangent_on(entry, aspect, fills), note["camera"]
            height = round(2 * up * model.fy)
            part = max(up * 2 * photograph["fy"] / photograph["height"], up * aspect * 2 * photograph["fx"] / photograph["width"])
            return shares(camera_of(entry, up, (round(height * aspect), height), world, model)), 100 * part

        print("| screen | areas filled | pixels opaque | seen | filled | of a photograph's width or height | before: areas | filled |")
        print("|---|---|---|---|---|---|---|---|")
        for name, (width, height) in SCREENS.items():
            aspect = width / height
            nearest = min(first, key=lambda e: abs(math.log(e["width"] / e["height"] / aspect)), default=None)
            before, _ = judge(note["camera"], aspect, False)
            then = f"{before['areas']:.1f} % | {before['filled']:.1f} % |"
            if nearest is None:
                print(f"| {name} | no first view | | | | | {then}")
                continue
            found, part = judge(nearest, aspect, True)
            now = " | ".join(f"{found[key]:.1f} %" for key in COLUMNS)
            print(f"| {name} | {now} | {part:.0f} % | {then}")
        own = [shares(capture.views[i].camera) for i in capture.train[:: max(1, len(capture.train) // MOST)]]
        mean = [sum(found[key] for found in own) / len(own) for key in COLUMNS]
        print(f"| photographs | {' | '.join(f'{v:.1f} %' for v in mean)} | 100 % | | |")


if __name__ == "__main__":
    main()
