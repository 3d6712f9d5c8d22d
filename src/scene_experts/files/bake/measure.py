"""What files and bakes cost: PSNR of the same views drawn from several scenes, against the photographs and against the first of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_experts.core.types import Camera, Mode
from scene_experts.data.capture import Capture
from scene_experts.evaluate.metrics import psnr
from scene_experts.files.bake.sums import Tell
from scene_experts.render import Rasterizer
from scene_experts.scene import Draws


@dataclass(frozen=True)
class Score:
    """Means over views, dB, from 8-bit pictures."""

    photographs: float  # PSNR against the photographs
    first: float  # PSNR against the pictures of the first scene; 100 for that scene itself


def counted(capture: Capture) -> list[int]:
    """The held-out views that can be scored: those whose mask leaves something."""
    return [i for i in capture.test if (mask := capture.frame(i).mask) is None or bool(mask.any())]


def nothing_counted(capture: Capture) -> str:
    """Why `counted` is empty, in words."""
    return "the masks leave nothing of the held-out views" if capture.test else "no view is held out"


@torch.no_grad()
def scores(
    scenes: Mapping[str, tuple[Draws, int]], capture: Capture, views: Sequence[int], rasterize: Rasterizer, tell: Tell | None = None
) -> dict[str, Score]:
    """The score of each scene, drawn at its step, over `views` (at least one, of `counted`) of the capture."""
    background = torch.tensor(capture.background)
    totals = {name: [0.0, 0.0] for name in scenes}
    for i, index in enumerate(views):
        camera, frame = capture.views[index].camera, capture.frame(index)
        pictures = {name: picture(draws, step, camera, background, rasterize) for name, (draws, step) in scenes.items()}
        first = next(iter(pictures.values()))
        for name, image in pictures.items():
            totals[name][0] += psnr(image, frame.rgb.float() / 255, frame.mask)
            totals[name][1] += psnr(image, first, frame.mask)
        if tell is not None:
            tell("measuring", i + 1, len(views))
    return {name: Score(a / len(views), b / len(views)) for name, (a, b) in totals.items()}


def picture(draws: Draws, step: int, camera: Camera, background: Tensor, rasterize: Rasterizer) -> Tensor:
    """The picture [H, W, 3] as an 8-bit file would hold it, in [0, 1]."""
    image = rasterize(draws(camera, step, Mode.DRAW, rasterize.visible).gaussians, camera, background).image
    return (image.clamp(0, 1) * 255 + 0.5).floor() / 255
