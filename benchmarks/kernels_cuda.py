"""Measure the rasteriser, the loss and Adam on a GPU against plain gsplat, plain torch and the bandwidth of a copy.

    python benchmarks/kernels_cuda.py --count 100000

Times are medians on the device after a warm-up. The rasteriser's peer is gsplat's own `rasterization` with the same Gaussians.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import torch

import explicit_gsplat
from decode_cuda import measure_copy_bandwidth, time_on_device
from scene_experts.bench.cloud import make_cloud, make_scene
from scene_experts.core.types import Camera, Gaussians
from scene_experts.render import choose
from scene_experts.training import photometric
from scene_experts.training.optim import FusedAdam

WARM_UP = 5
Timer = Callable[[Callable[[], object]], float]


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=100_000, help="Gaussians; also rows of Adam's columns")
    parser.add_argument("--width", type=int, default=800)
    parser.add_argument("--height", type=int, default=544)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--copy", type=int, default=512, metavar="MIB", help="size of the copy that measures the bandwidth")
    return parser


def measure(cases: dict[str, Callable[[], object]], rounds: int, timer: Timer) -> dict[str, float]:
    """Median milliseconds of each case; the cases take turns."""
    times: dict[str, list[float]] = {name: [] for name in cases}
    for _ in range(rounds + WARM_UP):
        for name, work in cases.items():
            times[name].append(timer(work))
    return {name: median(found[WARM_UP:]) for name, found in times.items()}


def raster_cases(g: Gaussians, camera: Camera, background: torch.Tensor) -> dict[str, Callable[[], object]]:
    """Forward and backward pass of the adapter, and of plain gsplat."""
    ours = choose("gsplat", "cuda")
    leaves = {name: getattr(g, name).detach().requires_grad_() for name in ("means", "quats", "scales", "opacities", "colors")}
    p = {"means": leaves["means"], "quats": leaves["quats"], "scales": g.scales.log().requires_grad_()}
    p |= {"opacities": torch.logit(g.opacities.clamp(1e-4, 1 - 1e-4)).requires_grad_()}
    p |= {"dc": ((g.colors - 0.5) / 0.28209479)[:, None].requires_grad_(), "rest": torch.zeros(len(g), 0, 3, device=g.means.device)}
    return {
        "rasteriser": lambda: ours(replace(g, **leaves), camera, background).image.sum().backward(),
        "plain gsplat": lambda: explicit_gsplat.draw(p, camera, 0, background).sum().backward(),
    }


def loss_cases(height: int, width: int) -> dict[str, Callable[[], object]]:
    """Forward and backward pass of L1 + SSIM: the Triton kernels and plain torch."""
    torch.manual_seed(0)
    image, target = (torch.rand(height, width, 3, device="cuda") for _ in range(2))
    image.requires_grad_()

    def plain() -> None:
        (0.8 * photometric.l1(image, target) + 0.2 * photometric.dissimilarity(image, target)).backward()

    return {
        "L1 + SSIM, Triton": lambda: torch.stack(photometric.photometric(image, target, 0.2)).sum().backward(),
        "L1 + SSIM, torch": plain,
    }


def adam_cases(count: int) -> dict[str, Callable[[], object]]:
    """A step over the columns of an anchor scene: all rows in Triton and in torch, and a tenth of the rows."""
    made = []
    for triton in (True, False):
        columns = {"feature": (32,), "offsets": (10, 3), "log_scaling": (6,)}
        parameters = {name: torch.nn.Parameter(torch.zeros(count, *shape, device="cuda")) for name, shape in columns.items()}
        for p in parameters.values():
            p.grad = torch.ones_like(p)
        made.append(FusedAdam([{"params": [p], "name": name, "lr": 1e-3, "by_row": True} for name, p in parameters.items()]))
        made[-1]._triton = made[-1]._triton and triton
    ours, plain = made
    rows = torch.randperm(count, device="cuda")[: count // 10].sort().values
    return {"Adam, Triton": ours.step, "Adam, torch": plain.step, "Adam, Triton, a tenth of the rows": lambda: ours.step(rows=rows)}


def list_bytes(count: int, height: int, width: int) -> dict[str, int]:
    """Bytes that each kernel must move at least, where that is what bounds it."""
    adam = 4 * count * (32 + 30 + 6) * 7  # value, two moments: read and written; gradient: read
    pixels = 4 * 3 * height * width
    return {"L1 + SSIM, Triton": 7 * pixels, "Adam, Triton": adam, "Adam, torch": adam, "Adam, Triton, a tenth of the rows": adam // 10}


def format_table(times: dict[str, float], least: dict[str, int], copy: float) -> str:
    """One line per case. copy: bytes per second of a plain copy."""
    lines = [f"{'':36}{'ms':>9}{'of the copy':>13}"]
    for name, milliseconds in times.items():
        share = f"{100 * least[name] / (1e-3 * milliseconds) / copy:.0f} %" if name in least else ""
        lines.append(f"{name:36}{milliseconds:9.3f}{share:>13}")
    return "\n".join(lines)


def main() -> None:
    args = make_parser().parse_args()
    if not torch.cuda.is_available():
        raise SystemExit("expected a CUDA device, found none; run this on a machine with one")
    g, camera = make_scene(make_cloud(), args.count, args.width, args.height)
    names = ("means", "quats", "scales", "opacities", "colors", "source")
    g, camera = Gaussians(*(getattr(g, name).to("cuda") for name in names)), camera.to("cuda")
    cases = raster_cases(g, camera, torch.zeros(3, device="cuda")) | loss_cases(args.height, args.width) | adam_cases(args.count)
    copy = measure_copy_bandwidth(args.rounds, args.copy)
    print(f"{torch.cuda.get_device_name()}, {args.count} Gaussians, {args.width}x{args.height}; a copy moves {copy / 1e9:.0f} GB/s")
    print(format_table(measure(cases, args.rounds, time_on_device), list_bytes(args.count, args.height, args.width), copy))


if __name__ == "__main__":
    main()
