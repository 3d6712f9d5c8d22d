"""The refinement of baked Gaussians: all parameters move together until the pictures agree with
those of the original scene."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from scene_experts.core.schedule import Rate
from scene_experts.core.types import Mode
from scene_experts.files.bake.views import Views
from scene_experts.files.gaussians.read import DRAWN_AT
from scene_experts.files.measure import Painter, Tell
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.training.optim import FusedAdam
from scene_experts.training.photometric import photometric


@dataclass(frozen=True)
class Refine:
    """How baked Gaussians are refined. Learning rates change log-linearly from first to last; the
    rate of means is multiplied by the extent."""

    iterations: int = 1000
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
) -> None:
    """Move the columns of `scene` until it draws what `painter` draws over `background` [3].

    Uses the training views, each once per epoch in random order, and free views around them.
    """
    rasterize, generator = painter.rasterize, torch.Generator().manual_seed(seed)
    groups = scene.rate_groups().items()
    optimizer = FusedAdam([{"params": params, "name": name, "lr": 0.0} for name, params in groups])
    free = (torch.rand(how.iterations, generator=generator) < how.free).tolist()
    queue: list[int] = []
    for i, is_free in enumerate(free):
        if not is_free and not queue:
            queue = torch.randperm(len(views), generator=generator).tolist()
        camera = views.free(generator) if is_free else views.cameras[queue.pop()]
        with torch.no_grad():
            target = painter.picture(camera, background).clamp_(0, 1)
        for group in optimizer.param_groups:
            rate: Rate = getattr(how, group["name"])
            group["lr"] = rate.at(i + 1, how.iterations) * (scene.extent if group["name"] == "means" else 1.0)
        image = rasterize(scene(camera, DRAWN_AT, Mode.TRAIN, rasterize.visible).gaussians, camera, background).image
        loss = sum(photometric(image, target, how.dssim))
        assert isinstance(loss, Tensor)
        if loss.requires_grad:
            loss.backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        tell("refining", i + 1, how.iterations)
