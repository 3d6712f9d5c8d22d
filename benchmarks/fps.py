"""Frames a second of trained scenes, decode and raster apart: every kind of decoder on a scene made in code, or runs of yours.

    OMP_NUM_THREADS=1 python benchmarks/fps.py [--anchors 40000] [--only moe-gs] [RUN ...]

Made scenes: half of the anchors fill an 800x544 picture; networks are as initialised, so about half of the Gaussians are drawn. A frame is
visibility filter, decode, rasterise. Times are minima of interleaved runs, processor time with one thread, wall time with more. Decodes:
the training's own; the frozen scene's (routing kept); the same with the features' part of the first layers kept too. Runs: medians over
their held-out views, as `scene-experts eval` measures them.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from scene_experts.bench.measure import Clock, Subject, clock_for, least
from scene_experts.bench.step import AT, work
from scene_experts.core.types import Mode
from scene_experts.evaluate import timing
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.training.run_folder import load_capture, open_run

KINDS = (
    *("scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-posrouter"),
    *(f"moe-gs-e{num}-{mix}" for num in (2, 3, 4, 5) for mix in ("top1", "top2", "dense")),
    *(f"scaffold-gs-depth{depth}" for depth in (2, 3, 4, 5, 6)),
)


def frames(recipe: str, anchors: int) -> tuple[Subject, int]:
    """Draws the recipe's made scene once and times (own decode, frozen, raster); and how many Gaussians are drawn."""
    made = work(recipe, anchors, 800, 544)
    scene, camera, rasterize = made.training.scene, made.camera, made.rasterize
    forms = (scene, scene.frozen(AT))

    @torch.no_grad()
    def frame(clock: Clock) -> tuple[float, ...]:
        times, decoded = [], None
        for form in forms:
            began = clock()
            decoded = form(camera, AT, Mode.DRAW, rasterize.visible)
            times.append(clock() - began)
        assert decoded is not None
        began = clock()
        rasterize(decoded.gaussians, camera, torch.zeros(3))
        return (*times, clock() - began)

    return frame, made.drawn()


def made_scenes(anchors: int, only: str, seconds: float) -> None:
    subjects, drawn = {}, {}
    for name in KINDS:
        if only in name and name in RECIPES:
            subjects[name], drawn[name] = frames(name, anchors)
    clock = clock_for(torch.get_num_threads())
    print(f"{anchors} anchors, half of them seen, 800x544, {torch.get_num_threads()} thread(s); ms")
    print("| recipe | Gaussians | own decode | frozen | raster | FPS, frozen |\n|---|---|---|---|---|---|")
    for name, (own, frozen, raster) in least(subjects, seconds * len(subjects), clock).items():
        parts = " | ".join(f"{1e3 * t:.1f}" for t in (own, frozen, raster))
        print(f"| {name} | {drawn[name]:,} | {parts} | {1 / (frozen + raster):.0f} |")


def runs(folders: list[Path]) -> None:
    print("| run | own decode ms | frozen ms | raster ms | FPS, own decode | FPS, frozen |\n|---|---|---|---|---|---|")
    for folder in folders:
        run = open_run(folder)
        capture = load_capture(run.config.data, run.cfg.seed)
        cameras = [capture.views[i].camera for i in capture.test or capture.train]
        background = torch.tensor(capture.background)
        s = timing.measure(run.scene, cameras, run.step, choose("auto", "cpu"), background)
        values = f"{s.ordinary_decode_ms:.1f} | {s.decode_ms:.1f} | {s.raster_ms:.1f} | {s.ordinary_fps:.1f} | {s.fps:.1f}"
        print(f"| {folder.name} | {values} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path, help="run folders; none: made scenes")
    parser.add_argument("--anchors", type=int, default=40_000)
    parser.add_argument("--only", default="", help="made scenes whose recipe contains this")
    parser.add_argument("--seconds", type=float, default=2.0, help="per made scene")
    args = parser.parse_args()
    if args.runs:
        runs(args.runs)
    else:
        made_scenes(args.anchors, args.only, args.seconds)


if __name__ == "__main__":
    main()
