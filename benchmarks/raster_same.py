"""Check that a change leaves the results of the CPU rasteriser bit-identical.

    python benchmarks/raster_same.py record before.json     # before the change
    python benchmarks/raster_same.py compare before.json    # with the change built; exit status 1 if anything differs

It hashes the image, alpha, depth, radii and all gradients in the deterministic mode, for every instruction set that this machine runs.
Bits may differ between processors and compilers, so the file is valid only on the machine that wrote it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path

import torch

from raster_scene import make_cloud, make_scene
from scene_experts.core.types import Gaussians
from scene_experts.native import library as native
from scene_experts.render.cpu import CpuRasterizer

CASES = ((20_000, 400, 301), (100_000, 800, 544))
NAMES = ("image", "alpha", "depth", "radii", "mean2d", "means", "quats", "scales", "opacities", "colors")


def hash_case(case: tuple[int, int, int], level: str, antialias: bool, threads: int) -> dict[str, str]:
    """Render one case and hash each result."""
    g, camera = make_scene(make_cloud(), *case)
    leaves = [t.clone().requires_grad_() for t in (g.means, g.quats, g.scales, g.opacities, g.colors)]
    draw = CpuRasterizer(level=level, antialias=antialias, deterministic=True, threads=threads)
    render = draw(Gaussians(*leaves, g.source), camera, torch.tensor([0.2, 0.5, 0.9]))
    rng = torch.Generator().manual_seed(0)
    parts = (render.image, render.alpha, render.depth)
    torch.stack([(torch.rand(part.shape, generator=rng) * part).sum() for part in parts]).sum().backward()
    results = (*parts, render.radii, render.mean2d_grad, *(leaf.grad for leaf in leaves))
    return {name: hashlib.sha256(t.detach().numpy().tobytes()).hexdigest()[:16] for name, t in zip(NAMES, results, strict=True)}  # type: ignore[union-attr]


def hash_all() -> dict[str, dict[str, str]]:
    """Hash all cases."""
    levels = [name for name in native.list_levels() if native.find(name)]
    return {
        f"{case[0]} {level} antialias={antialias}": hash_case(case, level, antialias, threads=1 + antialias)
        for case in CASES
        for level in levels
        for antialias in (False, True)
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "compare"))
    parser.add_argument("file", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    found = hash_all()
    if args.what == "record":
        args.file.write_text(json.dumps(found, indent=1))
        return
    recorded = json.loads(args.file.read_text())
    differ = [
        f"{case}: {', '.join(n for n in NAMES if recorded[case][n] != found[case][n])}"
        for case in found
        if recorded.get(case) != found[case]
    ]
    print("\n".join(differ) if differ else f"the same bits in {len(found)} cases")
    sys.exit(bool(differ))


if __name__ == "__main__":
    main()
