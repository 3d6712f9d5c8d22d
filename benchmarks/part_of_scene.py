"""How near the pictures of a part of a scene are to those of the whole: what a page could show while it loads.

    python benchmarks/part_of_scene.py RUN

The part holds the anchors that give most to the training views: sums of transmittance times
opacity over pixels. PSNR is that of held-out views to the whole scene's pictures: as the part is,
and divided by its opacity, which hides gaps.
"""

from __future__ import annotations

import argparse
import math
from dataclasses import fields, replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.types import Gaussians
from scene_experts.files.measure import Painter, capture_if_there
from scene_experts.training.run_folder import open_run

SHARES = (0.1, 0.15, 0.3, 0.5, 0.75)
EVERY, MOST = 3, 4  # training views that rank; views that are compared, at most


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(max(float((a.clamp(0, 1) - b).square().mean()), 1e-10))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("run", type=Path)
    run = open_run(parser.parse_args().run)
    scene: object = run.scene
    per_row = scene.K  # type: ignore[attr-defined]
    with capture_if_there(run, needed=True) as capture:
        assert capture is not None
        painter, background = Painter.of(run.scene, run.step, None, run.config.train.antialias), torch.tensor(capture.background)

        def rows(g: Gaussians) -> Tensor:
            return torch.div(g.source, per_row, rounding_mode="floor")

        given = torch.zeros(len(run.scene.positions))
        for i in capture.train[::EVERY]:
            g = painter.gaussians(capture.views[i].camera)
            colors = g.colors.detach().clone().requires_grad_()
            painter.rasterize(replace(g, colors=colors), capture.views[i].camera, background).image.sum().backward()
            assert colors.grad is not None
            given.index_add_(0, rows(g), colors.grad.sum(1) / 3)
        order = given.argsort(descending=True)
        print("| share of the anchors | share of what they give | PSNR, dB | without gaps, dB |\n|---|---|---|---|")
        with torch.no_grad():
            for share in SHARES:
                kept = torch.zeros(len(given), dtype=torch.bool)
                kept[order[: int(share * len(given))]] = True
                plain, filled = [], []
                for i in (capture.test or capture.train)[:MOST]:
                    camera = capture.views[i].camera
                    g = painter.gaussians(camera)
                    whole = painter.rasterize(g, camera, background).image.clamp(0, 1)
                    mask = kept[rows(g)]
                    part = painter.rasterize(Gaussians(*(getattr(g, f.name)[mask] for f in fields(Gaussians))), camera, background)
                    bare = part.image - (1 - part.alpha[..., None]) * background
                    plain.append(psnr(part.image, whole))
                    filled.append(psnr(bare / part.alpha.clamp_min(0.02)[..., None], whole))
                means = [sum(v) / len(v) for v in (plain, filled)]
                print(f"| {share:.0%} | {float(given[kept].sum() / given.sum()):.0%} | {means[0]:.1f} | {means[1]:.1f} |", flush=True)


if __name__ == "__main__":
    main()
