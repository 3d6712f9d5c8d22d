"""Time density control against the number of anchors: one densification step (grow and prune) and the statistics of one view.

Usage: python benchmarks/growth.py [--anchors 40000 400000 2000000] [--repeat 3] [--strong 0.03]
The anchors fill a slab of the lattice. `strong` is the share of slots whose gradient creates candidates.
Times are minima of processor time on one thread.
"""

from __future__ import annotations

import argparse
import math
import time

import torch

from scene_experts.core.table import Table
from scene_experts.core.types import Decoded, Gaussians, Render
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.strategy import observe
from scene_experts.strategy.grow import GrowAnchors

VOXEL, K, F = 0.01, 10, 32


def make_scene(anchors: int, strong: float) -> AnchorScene:
    """`anchors` distinct random cells in a half-full slab, with the statistics of 100 iterations."""
    generator = torch.Generator().manual_seed(0)
    side = max(4, round((2 * anchors * 16) ** (1 / 3)))
    cells = torch.randperm(side * side * max(1, side // 16), generator=generator)[:anchors]
    cells = torch.stack([cells % side, cells // side % side, cells // (side * side)], 1) - side // 2
    n = len(cells)
    params = {
        "feature": torch.randn(n, F, generator=generator),
        "offsets": torch.randn(n, K, 3, generator=generator),
        "log_scaling": torch.full((n, 6), math.log(3 * VOXEL)),
    }
    scene = AnchorScene(Anchors(K=K, F=F), Table(params, {"cell": cells, "xyz": (cells.double() * VOXEL).float()}), VOXEL, 5.0)
    observe.start(scene.table, K)
    stats, draw = scene.table.stats, torch.rand(n, K, generator=generator)
    stats["count"] = torch.where(draw < 0.3, 50.0, 20.0)
    stats["grad"] = stats["count"] * torch.where(draw < strong, 5e-4, 1e-5)
    stats["visits"] = torch.full((n,), 90.0)
    stats["opacity"] = torch.where(torch.rand(n, generator=generator) < 0.02, 0.1, 30.0)
    return scene


def make_view(scene: AnchorScene) -> tuple[Decoded, Render]:
    """The decode and render of one view: every second anchor, half of its slots."""
    rows = torch.arange(0, len(scene.table), 2)
    raw = torch.randn(len(rows), K)
    keep = (raw > 0).view(-1).nonzero().squeeze(1)
    source = rows[keep // K] * K + keep % K
    M = len(source)
    empty = torch.empty(0)
    gaussians = Gaussians(empty, empty, empty, empty, empty, source)
    radii = torch.randint(0, 5, (M,), dtype=torch.int32)
    return Decoded(gaussians, rows, raw, {}), Render(empty, empty, empty, radii, torch.randn(M, 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--anchors", type=int, nargs="+", default=[40_000, 400_000, 2_000_000])
    parser.add_argument("--repeat", type=int, default=3)
    parser.add_argument("--strong", type=float, default=0.03)
    args = parser.parse_args()
    torch.set_num_threads(1)
    print("  anchors  densification  ns/anchor     grown    pruned  statistics of a view    ns/anchor")
    for anchors in args.anchors:
        adjusting = watching = float("inf")
        for _ in range(args.repeat):
            scene = make_scene(anchors, args.strong)
            seen = make_view(scene)
            began = time.thread_time()
            observe.observe(scene.table, *seen)
            middle = time.thread_time()
            edit = GrowAnchors().update(scene, 1600, torch.Generator().manual_seed(0))
            adjusting, watching = min(adjusting, time.thread_time() - middle), min(watching, middle - began)
        assert edit is not None
        times = f"{1e3 * adjusting:8.1f} ms {1e9 * adjusting / anchors:13.0f} {edit.grown:9,} {edit.pruned:9,}"
        print(f"{anchors:9,} {times} {1e3 * watching:18.2f} ms {1e9 * watching / anchors:13.1f}")


if __name__ == "__main__":
    main()
