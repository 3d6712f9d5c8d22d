"""Scores of a rendered picture against its photograph: PSNR, SSIM, LPIPS, detail, sharpness. Each
name stands for one exact variant.

Pictures are [H, W, 3] float RGB in [0, 1] with 8-bit values, masks [H, W] in [0, 1] (1 = the pixel
counts). With a mask, only counted pixels are scored: the photograph replaces the rest of the
render, and the dissimilarity is divided by the counted area.
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
from scene_experts.core.progress import ByteProgress
from scene_experts.evaluate import weights
from scene_experts.evaluate.lpips import Lpips
from scene_experts.training import photometric

VARIANTS = {
    "psnr": "PSNR in dB per view over all pixels and channels of the 8-bit pictures, at most 100; mean over views",
    "ssim": "SSIM, 11 x 11 Gaussian window of sigma 1.5, zero padding, mean over pixels and channels (3DGS's variant)",
    "lpips": "LPIPS v0.1, VGG16, pictures in [-1, 1] as the network was trained on",
    "lpips_3dgs": "LPIPS v0.1, VGG16, pictures in [0, 1] as 3DGS, Scaffold-GS and their descendants publish it; for comparison with papers",
    "lpips_alex": "LPIPS v0.1, AlexNet, pictures in [-1, 1]",
}
OF_MASKED = {
    "psnr": "of masked views: over the pixels that the mask counts",
    **dict.fromkeys(
        (name for name in VARIANTS if name != "psnr"),
        "of masked views: both pictures show the photograph where the mask excludes, and the distance is divided by the share that counts",
    ),
}
"""What the metrics are of views with a mask."""
NETWORKS = {"lpips": "vgg", "lpips_3dgs": "vgg", "lpips_alex": "alex"}
LEAST_MSE = 1e-10  # identical pictures score 100 dB instead of infinity, which JSON cannot represent


def psnr(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return 20 log10(1 / sqrt(MSE)) in dB, at most 100."""
    squared = (image.double() - target.double()).square()
    mse = squared.mean() if mask is None else (squared * mask.double()[..., None]).sum() / (3 * mask.double().sum())
    return -10.0 * math.log10(max(float(mse), LEAST_MSE))


def psnr_aligned(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the PSNR after the colours of a picture are aligned with the photograph's: by the
    affine map of RGB with the least square error. It leaves exposure and white balance out."""
    colors, wanted = (picture.reshape(-1, 3).double() for picture in (image, target))
    inputs = torch.cat([colors, torch.ones_like(colors[:, :1])], 1)
    weighted = inputs if mask is None else inputs * mask.reshape(-1, 1).double()
    fit = torch.linalg.lstsq((weighted.T @ inputs).cpu(), (weighted.T @ wanted).cpu(), driver="gelsd").solution.to(image.device)
    return psnr((inputs @ fit).clamp(0, 1).reshape(image.shape), target, mask)


def ssim(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float:
    """Return the structural similarity (3DGS's variant), 1 for identical pictures."""
    filled, area = _fill_masked(image, target, mask)
    return 1.0 - (1.0 - float(photometric.ssim(filled, target))) / area


def sharpness(image: Tensor, mask: Tensor | None = None) -> float:
    """Return the mean norm of the brightness gradient (forward differences per pixel). Blur lowers
    it; 0 for a side of 1 px."""
    if min(image.shape[:2]) < 2:
        return 0.0
    length = _find_gradient(image).square().sum(dim=0).sqrt()
    if mask is None:
        return float(length.mean())
    weight = _of_differences(mask)
    return float((length * weight).sum() / weight.sum().clamp_min(1e-12))


def detail(image: Tensor, target: Tensor, mask: Tensor | None = None) -> float | None:
    """Return the share of the photograph's detail that the render has: the projection of its
    brightness gradient on that of the photograph, over the photograph's own.

    1 for identical pictures. Blur lowers it, and noise and specks do not raise it. None for a
    photograph without gradients.
    """
    ours, theirs = _find_gradient(image).double(), _find_gradient(target).double()
    if mask is not None:
        theirs = theirs * _of_differences(mask)
    whole = float((theirs * _find_gradient(target)).sum())
    return float((ours * theirs).sum()) / whole if whole > 0 else None


def _find_gradient(image: Tensor) -> Tensor:
    """Return the forward differences of the brightness [2, H - 1, W - 1]."""
    gray = image.mean(dim=2)
    return torch.stack([gray[:-1, 1:] - gray[:-1, :-1], gray[1:, :-1] - gray[:-1, :-1]])


def _of_differences(mask: Tensor) -> Tensor:
    """Return how much each forward difference counts [H - 1, W - 1]."""
    return torch.minimum(mask[:-1, :-1], torch.minimum(mask[:-1, 1:], mask[1:, :-1]))


def _fill_masked(image: Tensor, target: Tensor, mask: Tensor | None) -> tuple[Tensor, float]:
    """Return the render with the photograph where pixels do not count, and the fraction of the
    picture that counts."""
    if mask is None:
        return image, 1.0
    return torch.lerp(target, image, mask[..., None]), float(mask.mean())


@dataclass(frozen=True)
class Perceptual:
    """The LPIPS variants whose weights are on this machine, and why others are absent."""

    networks: dict[str, Lpips] = field(default_factory=dict)  # by backbone
    sources: dict[str, str] = field(default_factory=dict)  # by backbone: source of its weights
    absent: dict[str, str] = field(default_factory=dict)  # by metric: a sentence with the command that gets it

    @classmethod
    def find(
        cls,
        explicit: Path | None = None,
        device: torch.device | str = "cpu",
        fetch: bool = False,
        progress: ByteProgress | None = None,
    ) -> Perceptual:
        """Load the weights on this machine.

        Args:
            explicit: File or folder of the weights.
            device: Device of the networks.
            fetch: Download missing weights.
            progress: Called with the bytes so far and in total during a download.

        Raises:
            InputError: if `explicit` contains no weights.
            RunError: if a download fails.
        """
        networks, sources, absent = {}, {}, {}
        for net in dict.fromkeys(NETWORKS.values()):
            try:
                try:
                    tensors, sources[net] = weights.load(net, explicit)
                except weights.MissingWeights:
                    if not fetch:
                        raise
                    weights.download(net, progress=progress)
                    tensors, sources[net] = weights.load(net, explicit)
                networks[net] = Lpips(net, tensors).to(device)
            except weights.MissingWeights as error:
                absent |= {metric: str(error) for metric, backbone in NETWORKS.items() if backbone == net}
        return cls(networks, sources, absent)

    @classmethod
    def off(cls) -> Perceptual:
        """Return a value without networks, for an evaluation without LPIPS."""
        return cls(absent=dict.fromkeys(NETWORKS, "not computed: evaluate again without --no-lpips"))

    def __call__(self, image: Tensor, target: Tensor, mask: Tensor | None = None) -> dict[str, float]:
        """Return the scores of the available variants by name. Variants that this picture is too
        small for are added to `absent`."""
        filled, area = _fill_masked(image, target, mask)
        out: dict[str, float] = {}
        for metric, backbone in NETWORKS.items():
            network = self.networks.get(backbone)
            if network is None or metric in self.absent:
                continue
            x, y = (filled, target) if metric == "lpips_3dgs" else (2 * filled - 1, 2 * target - 1)
            try:
                out[metric] = network(x, y) / area
            except InputError as error:
                self.absent[metric] = str(error)
        return out


def score(image: Tensor, target: Tensor, mask: Tensor | None, perceptual: Perceptual) -> dict[str, float | None]:
    """Return every score of one view by name, with the sharpness of the render and of the
    photograph."""
    with _full_precision():
        return {
            "psnr": psnr(image, target, mask),
            "psnr_aligned": psnr_aligned(image, target, mask),
            "ssim": ssim(image, target, mask),
            **perceptual(image, target, mask),
            "detail": detail(image, target, mask),
            "sharpness": sharpness(image, mask),
            "sharpness_photo": sharpness(target, mask),
        }


@contextmanager
def _full_precision() -> Iterator[None]:
    """Compute convolutions in float32 on CUDA. By default cuDNN rounds inputs to 10 bits (TF32),
    which changes SSIM and LPIPS."""
    before = torch.backends.cudnn.allow_tf32
    torch.backends.cudnn.allow_tf32 = False
    try:
        yield
    finally:
        torch.backends.cudnn.allow_tf32 = before
