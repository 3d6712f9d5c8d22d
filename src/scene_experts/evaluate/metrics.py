"""Scores of a rendered picture against its photograph, from 8-bit values, each under a name that says which variant it is.

Pictures are [H, W, 3] float RGB in [0, 1], masks [H, W] in [0, 1] (1 counts). With a mask, a score is over the counted pixels alone: the
rest of the render is replaced by the photograph, and what dissimilarity is left is divided by the counted area instead of the whole.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.evaluate import download, weights
from scene_experts.evaluate.lpips import Lpips
from scene_experts.training import losses

VARIANTS = {
    "psnr": "PSNR in dB per view over all pixels and channels of the 8-bit pictures, 100 at most; mean over views",
    "ssim": "SSIM, 11 x 11 Gaussian window of sigma 1.5, zero padding, mean over pixels and channels (3DGS's variant)",
    "lpips": "LPIPS v0.1, VGG16, pictures in [-1, 1] as the network was trained on",
    "lpips_3dgs": "LPIPS v0.1, VGG16, pictures in [0, 1] as 3DGS, Scaffold-GS and their descendants publish it; compare papers by this",
    "lpips_alex": "LPIPS v0.1, AlexNet, pictures in [-1, 1]",
}
BACKBONE = {"lpips": "vgg", "lpips_3dgs": "vgg", "lpips_alex": "alex"}
LEAST_MSE = 1e-10  # identical pictures score 100 dB instead of infinity, which JSON cannot hold


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """20 log10(1 / sqrt(MSE)) in dB, at most 100."""
    squared = (image.double() - target.double()).square()
    mse = squared.mean() if mask is None else (squared * mask.double()[..., None]).sum() / (3 * mask.double().sum())
    return -10.0 * math.log10(max(float(mse), LEAST_MSE))


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Structural similarity (3DGS's variant), 1 for identical pictures."""
    filled, area = _filled(image, target, mask)
    return 1.0 - (1.0 - float(losses.ssim(filled, target))) / area


def sharpness(image: Tensor, mask: Tensor | None = None) -> float:
    """Mean length of the brightness gradient (forward differences, per pixel): a blurred copy of a picture has less of it."""
    gray = image.mean(dim=2)
    dx, dy = gray[:-1, 1:] - gray[:-1, :-1], gray[1:, :-1] - gray[:-1, :-1]
    length = (dx.square() + dy.square()).sqrt()
    if mask is None:
        return float(length.mean())
    weight = torch.minimum(mask[:-1, :-1], torch.minimum(mask[:-1, 1:], mask[1:, :-1]))
    return float((length * weight).sum() / weight.sum().clamp_min(1e-12))


def _filled(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, float]:
    """The render with the photograph where nothing counts, and the share of the picture that counts."""
    if mask is None:
        return image, 1.0
    return torch.lerp(target, image, mask[..., None]), float(mask.mean())


@dataclass(frozen=True)
class Perceptual:
    """The LPIPS variants whose weights are here, and why the others are absent."""

    networks: dict[str, Lpips] = field(default_factory=dict)  # by backbone
    sources: dict[str, str] = field(default_factory=dict)  # by backbone: where its weights came from
    absent: dict[str, str] = field(default_factory=dict)  # by metric: one sentence with the command that fixes it

    @classmethod
    def find(
        cls,
        explicit: Path | None = None,
        device: torch.device | str = "cpu",
        fetch: bool = False,
        progress: download.Progress | None = None,
    ) -> Perceptual:
        """Load what this machine has; `fetch` downloads the rest first. Raises InputError when `explicit` names no weights."""
        networks, sources, absent = {}, {}, {}
        for net in dict.fromkeys(BACKBONE.values()):
            if fetch and weights.why_absent(net, explicit):
                download.lpips(net, progress=progress)
            try:
                tensors, sources[net] = weights.load(net, explicit)
                networks[net] = Lpips(net, tensors).to(device)
            except weights.Missing as error:
                absent |= {metric: str(error) for metric, backbone in BACKBONE.items() if backbone == net}
        return cls(networks, sources, absent)

    @classmethod
    def off(cls) -> Perceptual:
        """None of them, because nobody asked."""
        return cls(absent=dict.fromkeys(BACKBONE, "not asked for: evaluate again without --no-lpips"))

    def __call__(self, image: Tensor, target: Tensor, mask: Tensor | None = None) -> dict[str, float]:
        """The variants that can be scored, by name; `absent` gains those that this size of picture rules out."""
        filled, area = _filled(image, target, mask)
        out: dict[str, float] = {}
        for metric, backbone in BACKBONE.items():
            network = self.networks.get(backbone)
            if network is None or metric in self.absent:
                continue
            x, y = (filled, target) if metric == "lpips_3dgs" else (2 * filled - 1, 2 * target - 1)
            try:
                out[metric] = network(x, y) / area
            except InputError as error:
                self.absent[metric] = str(error)
        return out


def score(image: Tensor, target: Tensor, mask: Tensor | None, perceptual: Perceptual) -> dict[str, float]:
    """Every score of one view, and the sharpness of render and photograph."""
    with _full_precision():
        return {
            "psnr": psnr(image, target, mask),
            "ssim": ssim(image, target, mask),
            **perceptual(image, target, mask),
            "sharpness": sharpness(image, mask),
            "sharpness_photo": sharpness(target, mask),
        }


@contextmanager
def _full_precision() -> Iterator[None]:
    """Convolutions in float32 on CUDA too: cuDNN rounds their inputs to 10 bits (TF32) by default, which moves SSIM and LPIPS."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
