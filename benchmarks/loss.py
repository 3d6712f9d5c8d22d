"""Time L1 + SSIM with its gradient: one call of the compiled library and plain torch, in one process.

    OMP_NUM_THREADS=1 python benchmarks/loss.py [--width 800 --height 544]

Times are minima of interleaved runs, in wall time and in CPU time of this process. Errors are against torch in float64.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import torch

from scene_experts.native import library as native
from scene_experts.training.photometric import l1, photometric, ssim


def compute_composed(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The loss in plain torch."""
    return 0.8 * l1(image, target) + 0.2 * (1 - ssim(image, target))


def compute_fused(image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The loss in one native call."""
    return sum(photometric(image, target, 0.2), start=torch.zeros(()))


def compute_gradient(loss: Callable[[torch.Tensor, torch.Tensor], torch.Tensor], image: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    leaf = image.clone().requires_grad_()
    loss(leaf, target).backward()
    assert leaf.grad is not None
    return leaf.grad


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--height", type=int, default=544)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--level", choices=native.LEVELS, help="instruction set of the library (default: the best of this processor)")
    args = parser.parse_args()
    if args.level:
        native.list_levels = lambda: (args.level,)
    if native.load() is None:
        raise SystemExit(native.explain_missing())
    torch.manual_seed(0)
    target = torch.rand(args.height // 8, args.width // 8, 3).repeat_interleave(8, 0).repeat_interleave(8, 1)
    image = (target + 0.05 * torch.randn_like(target)).clamp(0, 1)
    best = {name: [float("inf")] * 2 for name in ("torch", "fused")}
    for _ in range(args.rounds):
        for name, loss in (("torch", compute_composed), ("fused", compute_fused)):
            wall, cpu = time.perf_counter(), time.process_time()
            compute_gradient(loss, image, target)
            best[name] = [min(best[name][0], time.perf_counter() - wall), min(best[name][1], time.process_time() - cpu)]
    exact = compute_gradient(compute_composed, image.double(), target.double())
    value = float(compute_composed(image.double(), target.double()))
    print(f"{args.width}x{args.height}, {torch.get_num_threads()} threads, {native.load().level}")  # type: ignore[union-attr]
    for name, loss in (("torch", compute_composed), ("fused", compute_fused)):
        error = (compute_gradient(loss, image, target) - exact).norm() / exact.norm()
        off = abs(float(loss(image, target)) - value)
        wall, cpu = (1e3 * t for t in best[name])
        print(f"{name:6} {wall:7.1f} ms wall {cpu:7.1f} ms CPU   value off by {off:.1e}, gradient by {float(error):.1e} (relative L2)")
    print(f"fused is {best['torch'][1] / best['fused'][1]:.1f}x faster (CPU time)")


if __name__ == "__main__":
    main()
