"""Measure frames per second, decode and raster separately: every kind of decoder on a synthetic scene, or trained runs.

    OMP_NUM_THREADS=1 python benchmarks/fps.py [--anchors 40000] [--only moe-gs] [RUN ...]

Synthetic scenes: half of the anchors fill an 800x544 image; the networks are freshly initialised, so about half of the Gaussians are
drawn. A frame is visibility filter, decode and rasterisation. Times are minima of interleaved runs, processor time with one thread and
wall time with more. The script measures two decodes: that of the training ("own decode") and that of the frozen scene, which computes
its routing once. Runs: medians over their held-out views, measured as in `scene-experts eval`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from scene_experts.bench.measure import Clock, Subject, choose_clock, measure_minima
from scene_experts.bench.step import AT, make_work
from scene_experts.core.types import Mode
from scene_experts.data import capture as captures
from scene_experts.evaluate import timing
from scene_experts.render import choose
from scene_experts.training.recipes import RECIPES
from scene_experts.training.run_folder import open_run

KINDS = (
    *("scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-posrouter"),
    *(f"moe-gs-e{num}-{mix}" for num in (2, 3, 4, 5) for mix in ("top1", "top2", "dense")),
    *(f"scaffold-gs-depth{depth}" for depth in (2, 3, 4, 5, 6)),
)


def make_subject(recipe: str, anchors: int) -> tuple[Subject, int]:
    """A function that draws the recipe's synthetic scene once and times (own decode, frozen, raster); and the number of Gaussians."""
    made = make_work(recipe, anchors, 800, 544)
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

    return frame, made.count_drawn()


def measure_synthetic(anchors: int, only: str, seconds: float) -> None:
    subjects, drawn = {}, {}
    for name in KINDS:
        if only in name and name in RECIPES:
            subjects[name], drawn[name] = make_subject(name, anchors)
    clock = choose_clock(torch.get_num_threads())
    print(f"{anchors} anchors, half of them visible, 800x544, {torch.get_num_threads()} thread(s); ms")
    print("| recipe | Gaussians | own decode | frozen | raster | FPS, frozen |\n|---|---|---|---|---|---|")
    for name, (own, frozen, raster) in measure_minima(subjects, seconds * len(subjects), clock).items():
        parts = " | ".join(f"{1e3 * t:.1f}" for t in (own, frozen, raster))
        print(f"| {name} | {drawn[name]:,} | {parts} | {1 / (frozen + raster):.0f} |")


def measure_runs(folders: list[Path]) -> None:
    print("| run | own decode ms | frozen ms | raster ms | FPS, own decode | FPS, frozen |\n|---|---|---|---|---|---|")
    for folder in folders:
        run = open_run(folder)
        capture = captures.load(run.config.data, run.config.train.seed)
        cameras = [capture.views[i].camera for i in capture.test or capture.train]
        background = torch.tensor(capture.background)
        s = timing.measure_speed(run.scene, cameras, run.step, choose("auto", "cpu"), background)
        values = f"{s.ordinary_decode_ms:.1f} | {s.decode_ms:.1f} | {s.raster_ms:.1f} | {s.ordinary_fps:.1f} | {s.fps:.1f}"
        print(f"| {folder.name} | {values} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", nargs="*", type=Path, help="run folders; none: synthetic scenes")
    parser.add_argument("--anchors", type=int, default=40_000)
    parser.add_argument("--only", default="", help="only synthetic scenes whose recipe contains this text")
    parser.add_argument("--seconds", type=float, default=2.0, help="per synthetic scene")
    args = parser.parse_args()
    if args.runs:
        measure_runs(args.runs)
    else:
        measure_synthetic(args.anchors, args.only, args.seconds)


if __name__ == "__main__":
    main()
