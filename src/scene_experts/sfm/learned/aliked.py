"""ALIKED (Zhao et al., "ALIKED: a lighter keypoint and descriptor extraction network via deformable
transformation", IEEE Transactions on Instrumentation and Measurement 2023): from a photograph to
keypoints and descriptors.

Four blocks of convolutions see the picture at 1, 1/2, 1/8 and 1/32 of its size; the convolutions of
the last two are deformable. A layer of 1 x 1 gives each block a quarter of the features. The parts
are enlarged to the size of the picture (bilinearly, corners on corners) and joined; F are the joined
features, divided by their length at each pixel. The score of a pixel is computed from the joined
features by four convolutions and a sigmoid.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.sfm.learned.deform import deformable_conv, sample

CHANNELS = (16, 32, 64, 128)  # of the blocks
POOLS = (1, 2, 4, 4)  # how much smaller each block is than the one before it
COARSEST = 32  # px of the picture per pixel of the last block; sides are made multiples of it
DIM = 128  # of a descriptor
PLACES = 16  # that a descriptor is made of
HEAD = ((8, DIM, 1), (4, 8, 3), (4, 4, 3), (1, 4, 3))  # outputs, inputs and kernel of the convolutions of the score
FARTHEST = 0.25  # of the larger side of a layer: the limit of offsets


def tensor_shapes() -> dict[str, tuple[int, ...]]:
    """Return the names and shapes of the tensors of ALIKED-N16, as its authors name them."""
    out: dict[str, tuple[int, ...]] = {}
    before = 3
    for i, count in enumerate(CHANNELS, start=1):
        for half, inputs in enumerate((before, count), start=1):
            name = f"block{i}.conv{half}"
            if i > 2:
                out[f"{name}.offset_conv.weight"], out[f"{name}.offset_conv.bias"] = (18, inputs, 3, 3), (18,)
                name += ".regular_conv"
            out[f"{name}.weight"] = (count, inputs, 3, 3)
            for part in ("weight", "bias", "running_mean", "running_var"):
                out[f"block{i}.bn{half}.{part}"] = (count,)
            out[f"block{i}.bn{half}.num_batches_tracked"] = ()
        if i > 1:
            out[f"block{i}.downsample.weight"], out[f"block{i}.downsample.bias"] = (count, before, 1, 1), (count,)
        out[f"conv{i}.weight"] = (DIM // 4, count, 1, 1)
        before = count
    for i, (outputs, inputs, kernel) in enumerate(HEAD):
        out[f"score_head.{2 * i}.weight"] = (outputs, inputs, kernel, kernel)
    out["desc_head.agg_weights"] = (PLACES, DIM, DIM)
    out["desc_head.offset_conv.0.weight"], out["desc_head.offset_conv.0.bias"] = (2 * PLACES, DIM, 3, 3), (2 * PLACES,)
    out["desc_head.offset_conv.2.weight"], out["desc_head.offset_conv.2.bias"] = (2 * PLACES, 2 * PLACES, 1, 1), (2 * PLACES,)
    out["desc_head.sf_conv.weight"] = (DIM, DIM, 1, 1)
    return out


@dataclass(frozen=True)
class PictureFeatures:
    """The parts of F before they are enlarged: [32, H, W], [32, H / 2, W / 2], [32, H / 8, W / 8]
    and [32, H / 32, W / 32]."""

    levels: tuple[Tensor, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Height and width of F in pixels."""
        height, width = self.levels[0].shape[1:]
        return height, width

    def at_pixels(self, pixels: Tensor) -> Tensor:
        """Return F at whole pixels (x, y) [..., 2]: [DIM, ...]. The parts are enlarged only there."""
        height, width = self.size
        last = pixels.new_tensor([width - 1, height - 1])
        parts = [sample(level, pixels * pixels.new_tensor([level.shape[2] - 1, level.shape[1] - 1]) / last) for level in self.levels]
        return functional.normalize(torch.cat(parts), dim=0)

    def at(self, places: Tensor) -> Tensor:
        """Return F at places (x, y) between pixels [..., 2], bilinearly: [DIM, ...]; 0 outside."""
        height, width = self.size
        low = places.floor()
        part = places - low
        total = places.new_zeros((DIM, *places.shape[:-1]))
        for dx in (0, 1):
            for dy in (0, 1):
                pixel = low + places.new_tensor([dx, dy])
                inside = (pixel >= 0).all(-1) & (pixel[..., 0] < width) & (pixel[..., 1] < height)
                share = (part[..., 0] if dx else 1 - part[..., 0]) * (part[..., 1] if dy else 1 - part[..., 1])
                total += self.at_pixels(pixel) * (share * inside)
        return total


class Aliked:
    """ALIKED-N16 with its tensors, named as in `tensor_shapes`."""

    tensors: dict[str, Tensor]

    def __init__(self, tensors: dict[str, Tensor]) -> None:
        self.tensors = tensors

    @torch.no_grad()
    def look(self, picture: Tensor) -> tuple[PictureFeatures, Tensor]:
        """Return the features of a picture [3, H, W] (RGB in [0, 1], sides that are multiples of
        COARSEST, from twice that on) and its scores [H, W] in [0, 1]."""
        x, levels = picture, []
        for i, pool in enumerate(POOLS, start=1):
            x = self.block(functional.avg_pool2d(x[None], pool)[0] if pool > 1 else x, i)
            levels.append(functional.selu(self.conv(x, f"conv{i}")))
        return PictureFeatures(tuple(levels)), self.score(levels)

    def block(self, x: Tensor, i: int) -> Tensor:
        """Return the output of block i (1 to 4): two convolutions, and from the second block on
        the block's input, brought to its number of channels, is added."""
        y = functional.selu(self.convolve(x, i, 1))
        y = self.convolve(y, i, 2)
        return functional.selu(y + self.conv(x, f"block{i}.downsample") if i > 1 else y)

    def convolve(self, x: Tensor, i: int, half: int) -> Tensor:
        """Apply a convolution of block i, deformable in the last two blocks, and normalise its output
        by the statistics of the training."""
        name, norm = f"block{i}.conv{half}", f"block{i}.bn{half}"
        if i > 2:
            most = FARTHEST * max(x.shape[1:])
            y = deformable_conv(x, self.conv(x, f"{name}.offset_conv", 1).clamp(-most, most), self.tensors[f"{name}.regular_conv.weight"])
        else:
            y = self.conv(x, name, 1)
        mean, var, scale, shift = (self.tensors[f"{norm}.{part}"] for part in ("running_mean", "running_var", "weight", "bias"))
        return functional.batch_norm(y[None], mean, var, scale, shift)[0]

    def conv(self, x: Tensor, name: str, padding: int = 0) -> Tensor:
        """Apply the convolution `name` to x [C, H, W]."""
        return functional.conv2d(x[None], self.tensors[f"{name}.weight"], self.tensors.get(f"{name}.bias"), padding=padding)[0]

    def score(self, levels: list[Tensor]) -> Tensor:
        """Return the score of each pixel [H, W]. The first convolution has one tap, so it is applied
        to each part before that part is enlarged: both are linear."""
        first, size = self.tensors["score_head.0.weight"], levels[0].shape[1:]
        total = torch.zeros(())
        for level, weight in zip(levels, first.split(DIM // 4, dim=1), strict=True):
            total = total + functional.interpolate(functional.conv2d(level[None], weight), size, mode="bilinear", align_corners=True)[0]
        for i in (2, 4, 6):
            total = self.conv(functional.selu(total), f"score_head.{i}", 1)
        return total[0].sigmoid()

    @torch.no_grad()
    def describe(self, features: PictureFeatures, places: Tensor) -> Tensor:
        """Return the descriptors [N, DIM], of length 1, of keypoints at `places` (x, y) [N, 2].

        The features of the 3 x 3 pixels around a keypoint say where PLACES others lie relative to
        it; the descriptor is the sum of the features there, each place with a matrix of its own
        (the sparse deformable descriptor head).
        """
        height, width = features.size
        corner = torch.minimum(places.floor() - 1, places.new_tensor([width - 3, height - 3])).clamp(min=0)
        steps = torch.stack(torch.meshgrid(torch.arange(3), torch.arange(3), indexing="ij")[::-1], dim=-1).to(places)
        patch = features.at_pixels(corner[:, None, None] + steps).permute(1, 0, 2, 3)  # [N, DIM, 3, 3]
        head = "desc_head.offset_conv"
        hidden = functional.selu(functional.conv2d(patch, self.tensors[f"{head}.0.weight"], self.tensors[f"{head}.0.bias"]))
        offsets = functional.conv2d(hidden, self.tensors[f"{head}.2.weight"], self.tensors[f"{head}.2.bias"])
        most = FARTHEST * max(height, width)
        offsets = offsets.reshape(-1, 2, PLACES).transpose(1, 2).clamp(-most, most)  # x of all places, then y of all
        found = features.at(places[:, None] + offsets)  # [DIM, N, PLACES]
        found = functional.selu(torch.einsum("dc,cnp->npd", self.tensors["desc_head.sf_conv.weight"][:, :, 0, 0], found))
        return functional.normalize(torch.einsum("npc,pcd->nd", found, self.tensors["desc_head.agg_weights"]), dim=1)
