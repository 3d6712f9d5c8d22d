"""Time graph points (SAGS) against their number: building the graph, and one view's blend, hash grid and decode, forward + backward.

Usage: python benchmarks/graph.py [--points 30000 300000] [--repeat 3]
Half of the points are visible. The compiled functions are compared with plain torch. One thread, processor time, minima.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from unittest import mock

import torch

from scene_experts.core.table import Table
from scene_experts.core.types import Camera
from scene_experts.native import library as native
from scene_experts.scene.graph.network import Graph, blend_neighbours
from scene_experts.scene.graph.scene import GraphPoints, GraphScene


def make_scene(points: int) -> GraphScene:
    """Points on the wavy surfaces of a scene of extent 5, distributed like those of structure from motion."""
    generator = torch.Generator().manual_seed(0)
    uv = torch.rand(points, 2, generator=generator) * 10 - 5
    z = torch.sin(uv[:, :1] * 2) * torch.cos(uv[:, 1:]) + 0.02 * torch.randn(points, 1, generator=generator)
    cells = torch.round(torch.cat([uv, z], dim=1).double() / 0.005).long()
    params = {"feature": torch.randn(points, 32, generator=generator), "log_scaling": torch.full((points, 6), -4.0)}
    return GraphScene(
        GraphPoints(), Table(params, {"cell": cells, "xyz": (cells.double() * 0.005).float()}), 0.005, 5.0, (-5, -5, -5), 10.0
    )


def measure_minimum(run: Callable[[], object], repeat: int) -> float:
    """Minimum of `repeat` runs, milliseconds of processor time."""
    found = []
    for _ in range(repeat):
        began = time.process_time()
        run()
        found.append(1000 * (time.process_time() - began))
    return min(found)


def measure_both(run: Callable[[], object], repeat: int) -> tuple[float, float]:
    """Measure the compiled function and plain torch."""
    fast = measure_minimum(run, repeat)
    with mock.patch.object(native, "load", lambda level=None: None):
        return fast, measure_minimum(run, repeat)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, nargs="+", default=[30_000, 300_000])
    parser.add_argument("--repeat", type=int, default=3)
    args = parser.parse_args()
    torch.set_num_threads(1)
    camera = Camera(torch.eye(4), torch.tensor([[400.0, 0, 400], [0, 400, 272], [0, 0, 1]]), 800, 544, 0.2)
    print("points    build graph ms   blend ms (torch)   grid ms (torch)   whole decode ms (torch)   us/visible point")
    for points in args.points:
        scene = make_scene(points)
        rows = torch.randperm(points, generator=torch.Generator().manual_seed(1))[: points // 2].sort().values
        anew = measure_minimum(lambda: Graph.of(scene.table.facts["xyz"], 10), 1)  # noqa: B023
        found, weight = scene.graph().among(rows)
        xyz, feature = scene.table.facts["xyz"][rows], scene.table.params["feature"][rows].detach().requires_grad_()

        def blend() -> None:
            blend_neighbours(feature, found, weight).sum().backward()  # noqa: B023

        def grid() -> None:
            scene.grid(xyz).sum().backward()  # noqa: B023

        def decode() -> None:
            g = scene.decode(rows, camera).gaussians  # noqa: B023
            (g.means.sum() + g.scales.sum() + g.colors.sum() + g.opacities.sum() + g.quats.sum()).backward()

        a, b, c = (measure_both(run, args.repeat) for run in (blend, grid, decode))
        parts = [f"{fast:8.1f} ({slow:.1f})" for fast, slow in (a, b, c)]
        print(f"{points:7,} {anew:12.0f} {parts[0]:>20} {parts[1]:>18} {parts[2]:>24} {1000 * c[0] / len(rows):14.2f}", flush=True)


if __name__ == "__main__":
    main()
