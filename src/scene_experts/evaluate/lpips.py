"""LPIPS v0.1 (Zhang et al., CVPR 2018): the distance between two pictures in the feature space of
VGG16 or AlexNet.

    d(x, y) = sum_l mean_hw sum_c w_lc (f_l(x) / |f_l(x)| - f_l(y) / |f_l(y)|)^2

f_l are five ReLU outputs of the backbone, |.| is the norm over channels at one pixel, and w_l >= 0
are learned weights. Pictures are [H, W, 3], features [2, C, h, w] (both pictures together). Large
pictures are processed in strips of rows; the result is exact.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.errors import InputError

SHIFT = (-0.030, -0.088, -0.188)  # mean and standard deviation of ImageNet for RGB in [-1, 1]
SCALE = (0.458, 0.448, 0.450)
EPS = 1e-10  # added to the norm of a feature vector
STRIP = 1 << 24  # feature values per layer that are in memory at once, 64 MB; larger pictures are processed in strips of rows


@dataclass(frozen=True)
class Conv:
    """A convolution followed by a ReLU."""

    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class Stage:
    """The convolutions up to one of the five outputs that are compared. `pool`: kernel and stride
    of the max pooling before them."""

    convs: tuple[Conv, ...]
    pool: tuple[int, int] | None = None

    @property
    def halo(self) -> int:
        """Rows of context that the convolutions (stride 1) need on either side."""
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
SMALLEST = {"vgg": 16, "alex": 31}  # px; a smaller side leaves no features after the last pooling


def tensor_shapes(net: str) -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the tensors of `net` ("vgg" or "alex"): conv<i>.weight,
    conv<i>.bias and lin<l> (w_l)."""
    out: dict[str, tuple[int, ...]] = {}
    convs = [conv for stage in BACKBONES[net] for conv in stage.convs]
    for i, conv in enumerate(convs):
        out[f"conv{i}.weight"] = (conv.outputs, conv.inputs, conv.kernel, conv.kernel)
        out[f"conv{i}.bias"] = (conv.outputs,)
    for level, stage in enumerate(BACKBONES[net]):
        out[f"lin{level}"] = (stage.convs[-1].outputs,)
    return out


class Lpips:
    """LPIPS with one backbone: `Lpips("vgg", tensors)(x, y)`. The names of `tensors` are those of
    `tensor_shapes`."""

    net: str
    tensors: dict[str, Tensor]

    def __init__(self, net: str, tensors: dict[str, Tensor]) -> None:
        wanted = tensor_shapes(net)
        found = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
        if found != wanted:
            odd = sorted(name for name in wanted.keys() | found.keys() if wanted.get(name) != found.get(name))
            raise InputError(
                f"expected the {len(wanted)} tensors of LPIPS ({net}), found differences in {', '.join(odd[:4])}; get the weights again"
            )
        self.net, self.tensors = net, tensors

    def to(self, device: torch.device | str) -> Lpips:
        """Return the network on another device."""
        return Lpips(self.net, {name: tensor.to(device) for name, tensor in self.tensors.items()})

    @torch.no_grad()
    def __call__(self, x: Tensor, y: Tensor) -> float:
        """Return the distance between two pictures [H, W, 3] of one size, 0 for identical ones.

        The network was trained on RGB in [-1, 1]. Raises InputError if a side is below 16 px (VGG)
        or 31 px (AlexNet).
        """
        if x.shape != y.shape or x.dim() != 3 or x.shape[2] != 3:
            raise ValueError(f"expected two pictures [H, W, 3] of one size, found {tuple(x.shape)} and {tuple(y.shape)}")
        if min(x.shape[:2]) < SMALLEST[self.net]:
            raise InputError(
                f"LPIPS ({self.net}) expects pictures with sides of at least {SMALLEST[self.net]} px, "
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
        """Return one term of the distance and the input of the next stage. `first` is the index of
        the stage's first convolution."""
        rows, halo, height = self.strip_rows(f, stage, pool), stage.halo, f.shape[2]
        total, count, following = 0.0, 0, []
        for top in range(0, height, rows):
            bottom = min(top + rows, height)
            above, below = min(halo, top), min(halo, height - bottom)
            out = self.convolve(f[:, :, top - above : bottom + below], stage, first)
            if rows < height:  # drop the context rows, which saw padding instead of the picture
                out = out[:, :, above : above + bottom - top]
            total += self.distance(out, level)
            count += out.shape[2] * out.shape[3]
            if min(out.shape[2:]) > 1 or pool is None:
                following.append(out if pool is None else functional.max_pool2d(out, *pool))
        return total / count, torch.cat(following, dim=2)

    @staticmethod
    def strip_rows(f: Tensor, stage: Stage, pool: tuple[int, int] | None) -> int:
        """Return the number of rows per strip: all rows if strides or overlapping pools would not
        align at a cut."""
        if any(conv.stride != 1 for conv in stage.convs) or pool not in (None, (2, 2)):
            return f.shape[2]
        rows = STRIP // (2 * max(conv.outputs for conv in stage.convs) * f.shape[3])
        return max(2 * (rows // 2), 8)  # even, so that no 2 x 2 pool crosses a cut

    def convolve(self, f: Tensor, stage: Stage, first: int) -> Tensor:
        """Apply the convolutions and ReLUs of a stage."""
        for i, conv in enumerate(stage.convs, start=first):
            f = functional.conv2d(f, self.tensors[f"conv{i}.weight"], self.tensors[f"conv{i}.bias"], conv.stride, conv.padding)
            f = functional.relu_(f)
        return f

    def distance(self, f: Tensor, level: int) -> float:
        """Return sum_hw sum_c w_c (x - y)^2 of the features f [2, C, h, w] after normalising them
        to unit length."""
        unit = f / (f.square().sum(1, keepdim=True).sqrt() + EPS)
        squared = (unit[0] - unit[1]).square()
        return float((squared * self.tensors[f"lin{level}"][:, None, None]).sum(dtype=torch.float64))
