"""What a frame of a scene's page costs on paper: Gaussians and fragments of its first view.

    python benchmarks/page_frame.py RUN... [--size 1920x1080]

A fragment is a pixel of a Gaussian's quad, which reaches to where alpha is 1/255, as the page draws
it; quads are cut off at the borders of the screen. Prints the fragments in all and a pixel, those in
the ellipses, and what blending them takes at 60 GB/s where every blend reads and writes a pixel of
8 bytes (rgba16f) in memory; the arithmetic of a decode, and its time at 2 TFLOP/s, whole and for an
eighth of the groups a frame.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import torch

from scene_experts.core.types import Camera
from scene_experts.files.measure import Painter
from scene_experts.geometry.poses import with_fov
from scene_experts.render.reference import project
from scene_experts.training import run_folder
from scene_experts.view.filled import find_first_views

PIXEL, BANDWIDTH, FLOPS = 8, 60e9, 2e12
PARTS = 8  # a frame decodes one of them


def count_fragments(painter: Painter, camera: Camera) -> tuple[int, float, float]:
    """Return the Gaussians that a camera draws, and the pixels of their quads and ellipses."""
    g = painter.gaussians(camera)
    found = project(g.means, g.quats, g.scales, camera)
    opacity = g.opacities
    drawn = (found.radii > 0) & (opacity >= 1 / 255)
    xx, xy, yy = found.cov2d[drawn].unbind(1)
    reach = 2 * (255 * opacity[drawn]).log()
    x, y = found.mean2d[drawn].unbind(1)
    inside = torch.ones_like(x)
    for middle, half, side in ((x, (reach * xx).sqrt(), camera.width), (y, (reach * yy).sqrt(), camera.height)):
        inside *= ((middle + half).clamp(0, side) - (middle - half).clamp(0, side)) / (2 * half).clamp_min(1e-9)
    quads = 4 * reach * (xx * yy - xy * xy).clamp_min(0).sqrt() * inside
    return int(drawn.sum()), float(quads.sum()), math.pi / 4 * float(quads.sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--size", default="1920x1080")
    args = parser.parse_args()
    width, height = map(int, args.size.split("x"))
    torch.set_num_threads(1)
    for place in args.runs:
        show(place, width, height)


def show(place: Path, width: int, height: int) -> None:
    """Print the figures of one run."""
    run, black = run_folder.open_run(place), torch.zeros(3)
    capture = run_folder.capture_of(run)
    painter = Painter.of(run.scene, run.step, None, run.config.train.antialias)
    views = find_first_views(capture, lambda camera: painter.rasterize(painter.gaussians(camera), camera, black))
    wide = min((view.camera for view in views), key=lambda camera: abs(math.log(camera.width / camera.height / (width / height))))
    with torch.no_grad():
        count, quads, ellipses = count_fragments(painter, with_fov(wide, wide.fov, width, height))
    products = sum(math.prod(value.shape[-2:]) for value in run.scene.network_tensors().values() if value.ndim >= 2)
    anchors, pixels = len(run.scene.table), width * height
    blend, decode = 1000 * 2 * PIXEL / BANDWIDTH, 1000 * 2 * products / FLOPS  # ms for a fragment, for an anchor
    print(f"{capture.name}, {run.config.train.recipe}: {anchors:,} anchors, {count:,} Gaussians drawn at {width}x{height}")
    print(f"  fragments: {quads / 1e6:.0f} M of quads, {quads / pixels:.0f} a pixel; {ellipses / 1e6:.0f} M in ellipses")
    print(f"  blending: {blend * quads:.1f} ms of quads, {blend * ellipses:.1f} ms of ellipses")
    for n in (anchors, 100_000):
        print(f"  decode of {n:,} anchors, {products:,} products each: {decode * n:.2f} ms in all, {decode * n / PARTS:.2f} ms a frame")


if __name__ == "__main__":
    main()
