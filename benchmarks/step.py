"""A whole training step (decode, raster, loss, backward, density statistics, optimiser) beside the rasteriser's own forward + backward.

Usage: python benchmarks/step.py [--recipes moe-gs scaffold-gs] [--anchors 20000] [--size 800 544] [--threads 2]
The scene is random anchors in front of one camera. Prints minima over interleaved rounds, the time of each part, and the ratios that
docs/performance.md quotes.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import torch

from scene_experts.losses import terms
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.scene.anchors import AnchorScene
from scene_experts.state import Training
from scene_experts.strategy import observe
from scene_experts.types import Camera, Points


def make(recipe: str, anchors: int, width: int, height: int) -> tuple[Training, Camera]:
    """Random anchors filling the picture of one camera; networks as initialised, features random so that experts differ."""
    torch.manual_seed(0)
    cfg = RECIPES[recipe][1]
    depth = 3 + 5 * torch.rand(anchors)
    side = (torch.rand(anchors, 2) - 0.5) * torch.tensor([1.0, height / width])
    xyz = torch.cat([side * depth[:, None], depth[:, None]], 1).double()
    K = torch.tensor([[width * 1.0, 0, width / 2], [0, width * 1.0, height / 2], [0, 0, 1.0]])
    config = replace(cfg.scene, voxel_size=1e-4)
    scene = AnchorScene.from_points(config, Points(xyz, torch.zeros(anchors, 3, dtype=torch.uint8)), 5.0)
    scene.table.params["feature"].data.normal_()
    scene.table.params["offsets"].data.normal_(0, 0.5)
    observe.start(scene.table, scene.K)
    return Training(replace(cfg, scene=config), scene), Camera(torch.eye(4), K, width, height, 0.2)


def step(training: Training, camera: Camera, rasterize, target, times: dict[str, float]) -> int:
    """One step at iteration 2,000 (sparse); adds the seconds of its parts to `times`. Returns the Gaussians drawn."""
    clock = [time.perf_counter()]

    def lap(name: str) -> None:
        clock.append(time.perf_counter())
        times[name] = times.get(name, 0.0) + clock[-1] - clock[-2]

    training.step = 2000
    training.set_rates()
    decoded = training.scene(camera, 2000, True, rasterize.visible)
    lap("cull + decode")
    render = rasterize(decoded.gaussians, camera, torch.zeros(3))
    lap("raster")
    loss = torch.stack(list(terms(decoded, render, target, training.cfg.loss, 2000).values())).sum()
    lap("loss")
    loss.backward()
    lap("backward")
    observe.observe(training.scene.table, decoded, render)
    lap("statistics")
    training.optimizer.step()
    training.optimizer.zero_grad(set_to_none=True)
    lap("adam")
    return len(decoded.gaussians)


def raster_alone(training: Training, camera: Camera, rasterize) -> float:
    """Seconds of the rasteriser's forward + backward on the Gaussians of this scene."""
    with torch.no_grad():
        g = training.scene(camera, 2000, False, rasterize.visible).gaussians
    leaf = lambda t: t.clone().requires_grad_()  # noqa: E731
    g = replace(g, means=leaf(g.means), quats=leaf(g.quats), scales=leaf(g.scales), opacities=leaf(g.opacities), colors=leaf(g.colors))
    upstream = torch.rand(camera.height, camera.width, 3)
    began = time.perf_counter()
    rasterize(g, camera, torch.zeros(3)).image.backward(upstream)
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recipes", nargs="+", default=["moe-gs", "scaffold-gs"])
    parser.add_argument("--anchors", type=int, default=20_000)
    parser.add_argument("--size", type=int, nargs=2, default=[800, 544])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=12)
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    rasterize = choose("auto", "cpu")
    width, height = args.size
    target = torch.rand(height, width, 3)
    made = {name: make(name, args.anchors, width, height) for name in args.recipes}
    best: dict[str, dict[str, float]] = {name: {} for name in made}
    alone, whole, drawn = dict.fromkeys(made, float("inf")), dict.fromkeys(made, float("inf")), {}
    for _ in range(args.rounds):
        for name, (training, camera) in made.items():
            state = {k: v.detach().clone() for k, v in training.scene.state_dict().items()}
            alone[name] = min(alone[name], raster_alone(training, camera, rasterize))
            times: dict[str, float] = {}
            drawn[name] = step(training, camera, rasterize, target, times)
            whole[name] = min(whole[name], sum(times.values()))
            best[name] = {k: min(v, best[name].get(k, v)) for k, v in times.items()}
            training.scene.load_state_dict(state)
    for name in made:
        size = f"{width}x{height}, {args.threads} threads, raster {rasterize.name}"
        print(f"{name}: {args.anchors:,} anchors, {drawn[name]:,} Gaussians drawn, {size}")
        for part, seconds in best[name].items():
            print(f"  {part:<14} {1e3 * seconds:7.1f} ms")
        against = f"{whole[name] / alone[name]:.2f} x raster alone ({1e3 * alone[name]:.1f} ms)"
        print(f"  {'whole step':<14} {1e3 * whole[name]:7.1f} ms = {against}")
    if {"moe-gs", "scaffold-gs"} <= set(made):
        print(f"moe-gs step / scaffold-gs step: {whole['moe-gs'] / whole['scaffold-gs']:.2f}")


if __name__ == "__main__":
    main()
