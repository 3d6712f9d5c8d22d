"""Time a whole training step (target, decode, raster, loss, backward, density statistics, Adam) and its parts.

Usage: python benchmarks/step.py [--recipes moe-gs scaffold-gs] [--anchors 40000] [--size 800 544] [--threads 2] [--rounds 15] [--same]
The scene has random anchors, half of them in front of one camera. Times are wall time, minima over interleaved rounds. The script prints
the time of each part and the ratios of docs/performance.md: to the rasteriser alone, and to the scalar peer's forward + backward on the
same Gaussians (one thread of plain C++, bench/peer.py). compare_checkouts.py compares two versions of the package.
"""

from __future__ import annotations

import argparse
import time

import torch

from scene_experts.bench import peer, raster
from scene_experts.bench.step import BASELINE, MIXTURE, PARTS, Work, copy_networks, make_work
from scene_experts.core.types import Gaussians, Mode
from scene_experts.native import library as native


def time_target(pixels: torch.Tensor, step: Work) -> float:
    """Seconds to convert the target from the bytes [H, W, 3] of the image cache to floats."""
    began = time.perf_counter()
    step.target.copy_(pixels.to("cpu", torch.float32).div_(255.0))
    return time.perf_counter() - began


@torch.no_grad()
def draw_gaussians(step: Work) -> Gaussians:
    """The Gaussians that one step draws."""
    g = step.training.scene(step.camera, 2000, Mode.DRAW, step.rasterize.visible).gaussians
    return Gaussians(*(t.detach() for t in (g.means, g.quats, g.scales, g.opacities, g.colors)), g.source)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--recipes", nargs="+", default=["moe-gs", "scaffold-gs"])
    parser.add_argument("--anchors", type=int, default=40_000)
    parser.add_argument("--size", type=int, nargs=2, default=[800, 544])
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--same", action="store_true", help="copy the network of scaffold-gs to every expert of moe-gs")
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--peer", type=int, default=2, help="rounds in which the peer runs too (it takes seconds per round)")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    width, height = args.size
    made = {name: make_work(name, args.anchors, width, height) for name in args.recipes}
    both = {MIXTURE, BASELINE} <= set(made)
    if args.same and both:
        copy_networks(made[MIXTURE], made[BASELINE])
    pixels = torch.randint(0, 256, (height, width, 3), dtype=torch.uint8)
    upstream, slow = torch.rand(height, width, 3), peer.load(getattr(native.load(), "level", None))
    parts = ("target", *PARTS)
    best = {name: dict.fromkeys(parts, float("inf")) for name in made}
    whole, alone, scalar = (dict.fromkeys(made, float("inf")) for _ in range(3))
    for turn in range(args.rounds):
        for name, step in made.items():
            times = (time_target(pixels, step), *step(time.perf_counter))
            best[name] = {part: min(best[name][part], t) for part, t in zip(parts, times, strict=True)}
            whole[name] = min(whole[name], sum(times))
            picture = raster.Picture(draw_gaussians(step), step.camera, upstream)
            alone[name] = min(alone[name], sum(raster.time_draw(step.rasterize, picture, time.perf_counter)))
            if slow is not None and turn < args.peer:
                scalar[name] = min(scalar[name], sum(slow.draw(picture.gaussians, step.camera, upstream, time.perf_counter)[:2]))
    for name, step in made.items():
        counts = f"{args.anchors // 2:,} visible of {args.anchors:,} anchors, {step.count_drawn():,} Gaussians"
        print(f"{name}: {counts}, {width}x{height}, {args.threads} thread(s), raster {step.rasterize.name}")
        for part, seconds in best[name].items():
            print(f"  {part:<14} {1e3 * seconds:7.2f} ms")
        against = f"{whole[name] / alone[name]:.2f} x raster alone ({1e3 * alone[name]:.1f} ms)"
        ratio = f"{whole[name] / scalar[name]:.4f} x {peer.NAME} ({1e3 * scalar[name]:.0f} ms)"
        print(f"  {'whole step':<14} {1e3 * whole[name]:7.2f} ms = {against}, {ratio if scalar[name] < float('inf') else peer.WHY_NOT}")
    if both:
        print(f"{MIXTURE} step / {BASELINE} step{', same Gaussians' * args.same}: {whole[MIXTURE] / whole[BASELINE]:.2f}")


if __name__ == "__main__":
    main()
