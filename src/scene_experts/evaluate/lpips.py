"""LPIPS v0.1 (Zhang et al., CVPR 2018) in plain torch: the distance of two pictures in the feature space of VGG16 or AlexNet.

    d(x, y) = sum_l mean_hw sum_c w_lc (f_l(x) / |f_l(x)| - f_l(y) / |f_l(y)|)^2

f_l are five ReLU outputs of the backbone, |.| the length over channels at one pixel, w_l learned weights >= 0. Shapes: pictures [H, W, 3],
features [2, C, h, w] (both pictures at once). Large pictures pass in strips of rows, with exactly the value of the whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.errors import InputError

SHIFT = (-0.030, -0.088, -0.188)  # what LPIPS subtracts from RGB in [-1, 1] and divides by: ImageNet's statistics in that range
SCALE = (0.458, 0.448, 0.450)
EPS = 1e-10  # added to the length of a feature vector
STRIP = 1 << 24  # feature values held at once per layer, about 64 MB; taller pictures are cut into strips of rows


@dataclass(frozen=True)
class Conv:
    """One convolution, followed by a ReLU."""

    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Stage:
    """Convolutions up to one of the five outputs that are compared; `pool` is (kernel, stride) of the maximum before them."""

    convs: tuple[Conv, ...]
    pool: tuple[int, int] | None = None

    @property
    def halo(self) -> int:
        """Rows of context that the convolutions see on either side (stride 1)."""
        return sum(conv.padding for conv in self.convs)


BACKBONES: dict[str, tuple[Stage, ...]] = {
    "vgg": (
        Stage((Conv(3, 64), Conv(64, 64))),
        Stage((Conv(64, 128), Conv(128, 128)), (2, 2)),
        Stage((Conv(128, 256), Conv(256, 256), Conv(256, 256)), (2, 2)),
        Stage((Conv(256, 512), Conv(512, 512), Conv(512, 512)), (2, 2)),
        Stage((Conv(512, 512), Conv(512, 512), Conv(512, 512)), (2, 2)),
    ),
    "alex": (
        Stage((Conv(3, 64, 11, 4, 2),)),
        Stage((Conv(64, 192, 5, 1, 2),), (3, 2)),
        Stage((Conv(192, 384),), (3, 2)),
        Stage((Conv(384, 256),)),
        Stage((Conv(256, 256),)),
    ),
}
SMALLEST = {"vgg": 16, "alex": 31}  # px; a smaller side leaves no feature after the last pooling


def shapes(net: str) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tensors of `net` ("vgg" or "alex"): conv<i>.weight, conv<i>.bias and lin<l>, the w_l above."""
    out: dict[str, tuple[int, ...]] = {}
    convs = [conv for stage in BACKBONES[net] for conv in stage.convs]
    for i, conv in enumerate(convs):
        out[f"conv{i}.weight"] = (conv.outputs, conv.inputs, conv.kernel, conv.kernel)
        out[f"conv{i}.bias"] = (conv.outputs,)
    for level, stage in enumerate(BACKBONES[net]):
        out[f"lin{level}"] = (stage.convs[-1].outputs,)
    return out


class Lpips:
    """LPIPS with one backbone: `Lpips("vgg", tensors)(x, y)`. `tensors` are named as `shapes` says."""

    def __init__(self, net: str, tensors: dict[str, Tensor]) -> None:
        wanted = shapes(net)
        found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if found != wanted:
            odd = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
            raise InputError(f"expected the {len(wanted)} tensors of LPIPS ({net}), found others at {odd[:4]}; get the weights again")
        self.net, self.tensors = net, tensors

    def to(self, device: torch.device | str) -> Lpips:
        """The same on another device."""
        return Lpips(self.net, {name: tensor.to(device) for name, tensor in self.tensors.items()})

    @torch.no_grad()
    def __call__(self, x: Tensor, y: Tensor) -> float:
        """Distance of two pictures [H, W, 3] of one size, RGB in [-1, 1] as the network was trained on (0: alike).

        Raises InputError where a side is below 16 px (VGG) or 31 px (AlexNet).
        """
        if x.shape != y.shape or x.dim() != 3 or x.shape[2] != 3:
            raise ValueError(f"expected two pictures [H, W, 3] of one size, found {tuple(x.shape)} and {tuple(y.shape)}")
        if min(x.shape[:2]) < SMALLEST[self.net]:
            raise InputError(
                f"expected pictures of at least {SMALLEST[self.net]} px a side for LPIPS ({self.net}), "
                f"found {x.shape[1]} x {x.shape[0]}; evaluate at a larger resolution"
            )
        pair = torch.stack([x, y]).permute(0, 3, 1, 2).float()
        shift, scale = (pair.new_tensor(v)[:, None, None] for v in (SHIFT, SCALE))
        f = (pair - shift) / scale
        total, first = 0.0, 0
        stages = BACKBONES[self.net]
        for level, stage in enumerate(stages):
            pool = stages[level + 1].pool if level + 1 < len(stages) else None
            distance, f = self.stage(f, stage, first, level, pool)
            total += distance
            first += len(stage.convs)
        return total

    def stage(self, f: Tensor, stage: Stage, first: int, level: int, pool: tuple[int, int] | None) -> tuple[float, Tensor]:
        """One term of the distance, and the input of the next stage. `first` is the number of the stage's first convolution."""
        rows, halo, height = self.strip(f, stage, pool), stage.halo, f.shape[2]
        total, count, following = 0.0, 0, []
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            above, below = min(halo, top), min(halo, height - bottom)
            out = self.convolve(f[:, :, top - above : bottom + below], stage, first)
            if rows < height:  # the halo's rows saw padding where the picture goes on: drop them
                out = out[:, :, above : above + bottom - top]
            total += self.distance(out, level)
            count += out.shape[2] * out.shape[3]
            if min(out.shape[2:]) > 1 or pool is None:
                following.append(out if pool is None else functional.max_pool2d(out, *pool))
        return total / count, torch.cat(following, dim=2)

    @staticmethod
    def strip(f: Tensor, stage: Stage, pool: tuple[int, int] | None) -> int:
        """How many rows pass at once: all of them where strides or overlapping pools would not line up at a cut."""
        if any(conv.stride != 1 for conv in stage.convs) or pool not in (None, (2, 2)):
            return f.shape[2]
        rows = STRIP // (2 * max(conv.outputs for conv in stage.convs) * f.shape[3])
        return max(2 * (rows // 2), 8)  # even: a pool of 2 x 2 never straddles a cut

    def convolve(self, f: Tensor, stage: Stage, first: int) -> Tensor:
        for i, conv in enumerate(stage.convs, start=first):
            f = functional.conv2d(f, self.tensors[f"conv{i}.weight"], self.tensors[f"conv{i}.bias"], conv.stride, conv.padding)
            f = functional.relu_(f)
        return f

    def distance(self, f: Tensor, level: int) -> float:
        """sum_hw sum_c w_c (x - y)^2 of the unit-length features f [2, C, h, w]."""
        unit = f / (f.square().sum(1, keepdim=True).sqrt() + EPS)
        squared = (unit[0] - unit[1]).square()
        return float((squared * self.tensors[f"lin{level}"][:, None, None]).sum(dtype=torch.float64))
