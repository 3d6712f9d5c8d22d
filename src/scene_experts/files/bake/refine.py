"""The refinement of baked Gaussians: all parameters move together until the pictures agree with
those of the original scene."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import fmean

import torch
from torch import Tensor

from scene_experts.core.schedule import Rate
from scene_experts.core.types import Mode
from scene_experts.evaluate.metrics import psnr
from scene_experts.files.bake.views import Views
from scene_experts.files.gaussians.read import DRAWN_AT
from scene_experts.files.measure import Painter, Tell
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.training.optim import FusedAdam
from scene_experts.training.photometric import photometric

LEAST, MOST = 200, 1000  # iterations
LOOKS = 8  # views that decide between them
FEW = 20  # training views up to which LEAST iterations are enough (results/export.md)
CLOSE, FAR = 41.0, 34.0
"""PSNR, dB, before the refinement of scenes for which LEAST and MOST iterations are enough: banana
(41.1) loses nothing with 200; fox (33.6) loses 0.64 dB on held-out views with 200 and 0.15 with
1,000."""


def iterations_for(psnr: float, views: int) -> int:
    """Return the iterations for a scene with this number of training views whose pictures have this
    PSNR, dB, to those they should be."""
    if views <= FEW:
        return LEAST
    share = min(max((CLOSE - psnr) / (CLOSE - FAR), 0.0), 1.0)
    return round(LEAST + share * (MOST - LEAST))


@dataclass(frozen=True)
class Refine:
    """How baked Gaussians are refined. Learning rates change log-linearly from first to last; the
    rate of means is multiplied by the extent."""

    iterations: int | None = None
    """None: LEAST for few views, else up to MOST, by how far the scene is from the pictures."""
    free: float = 0.6
    """Share of iterations that use free views."""
    dssim: float = 0.2
    """Weight of 1 - SSIM in the loss; L1 has the rest."""
    means: Rate = Rate(0.00012, 0.000005)
    log_scales: Rate = Rate(0.015, 0.0015)
    quats: Rate = Rate(0.006, 0.0006)
    raw_opacity: Rate = Rate(0.09, 0.009)
    sh_dc: Rate = Rate(0.015, 0.0015)
    sh_rest: Rate = Rate(0.003, 0.0003)


def refine(
    scene: GaussianScene,
    painter: Painter,
    views: Views,
    background: Tensor,
    how: Refine,
    seed: int,
    tell: Tell,
) -> int:
    """Move the columns of `scene` until it draws what `painter` draws over `background` [3]; returns
    the iterations.

    Uses the training views, each once per epoch in random order, and free views around them.
    """
    iterations = how.iterations
    if iterations is None:
        iterations = iterations_for(compare(scene, painter, views, background), len(views))
    rasterize, generator = painter.rasterize, torch.Generator().manual_seed(seed)
    groups = scene.rate_groups().items()
    optimizer = FusedAdam([{"params": params, "name": name, "lr": 0.0} for name, params in groups])
    free = (torch.rand(iterations, generator=generator) < how.free).tolist()
    queue: list[int] = []
    for i, is_free in enumerate(free):
        if not is_free and not queue:
            queue = torch.randperm(len(views), generator=generator).tolist()
        camera = views.free(generator) if is_free else views.cameras[queue.pop()]
        with torch.no_grad():
            target = painter.picture(camera, background).clamp_(0, 1)
        for group in optimizer.param_groups:
            rate: Rate = getattr(how, group["name"])
            group["lr"] = rate.at(i + 1, iterations) * (scene.extent if group["name"] == "means" else 1.0)
        image = rasterize(scene(camera, DRAWN_AT, Mode.TRAIN, rasterize.visible).gaussians, camera, background).image
        loss = sum(photometric(image, target, how.dssim))
        assert isinstance(loss, Tensor)
        if loss.requires_grad:
            loss.backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        tell("refining", i + 1, iterations)
    return iterations


@torch.no_grad()
def compare(scene: GaussianScene, painter: Painter, views: Views, background: Tensor) -> float:
    """Return the mean PSNR, dB, of a scene's pictures to the painter's, over LOOKS training views."""
    ours, chosen = Painter(scene, DRAWN_AT, painter.rasterize), views.cameras[:: max(1, len(views) // LOOKS)][:LOOKS]
    pairs = ((ours.picture_8bit(camera, background), painter.picture_8bit(camera, background)) for camera in chosen)
    return fmean(psnr(a, b) for a, b in pairs)
