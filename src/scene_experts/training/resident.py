"""The photographs of a training on its device."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from scene_experts.core.transfer import upload
from scene_experts.data.capture import Capture

SHARE = 4  # of the memory that is free on a GPU when a training begins, photographs may take one part in so many
DEPTHS = 1 << 29  # bytes of depth maps that stay on a CPU
AHEAD = 3  # threads that decode photographs for a GPU, as the cores are free


def average(picture: Tensor, by: int) -> Tensor:
    """Return the means of the blocks of by x by pixels of a picture [H, W, ...], in float32 for whole
    numbers. Rows and columns that fill no block are left out."""
    height, width = picture.shape[0] // by * by, picture.shape[1] // by * by
    total = picture[0:height:by, 0:width:by].to(picture.dtype if picture.is_floating_point() else torch.float32, copy=True)
    for place in range(1, by * by):
        total += picture[place // by : height : by, place % by : width : by]
    return total.div_(by * by)


class Resident:
    """Photographs as a training sees them. On a GPU they stay there, 3 bytes a pixel, as far as the
    budget allows; the others are decoded ahead and copied each time.

    A view is seen in random order and only ever dropped with the object, so keeping the first ones
    that are seen is as good as any other choice.
    """

    def __init__(self, capture: Capture, device: str, dtype: torch.dtype, budget: int | None = None) -> None:
        """budget: Bytes of the device. None is a quarter of its free memory, and 0 on the CPU."""
        self.capture, self.device, self.dtype = capture, torch.device(device), dtype
        gpu = self.device.type == "cuda"
        self.threads = AHEAD if gpu else 1
        self.budget = budget if budget is not None else torch.cuda.mem_get_info(self.device)[0] // SHARE if gpu else 0
        self.used = 0
        self.kept: dict[int, tuple[Tensor, Tensor | None]] = {}
        self.depths: dict[int, Tensor] = {}
        self.backgrounds: dict[tuple[float, ...], Tensor] = {}

    def see(self, index: int, by: int = 1) -> tuple[Tensor, Tensor | None]:
        """Return the photograph [H, W, 3] in [0, 1] and its mask [H, W] or None, as the device and
        dtype want them, at 1 / by of their size (`Camera.shrunk`). Raises InputError if its file cannot
        be read."""
        pixels = self.kept.get(index)
        if pixels is None:
            frame = self.capture.frame(index)
            pixels = upload(frame.rgb, self.device), None if frame.mask is None else upload(frame.mask, self.device, self.dtype)
            size = sum(t.numel() * t.element_size() for t in pixels if t is not None)
            if self.used + size <= self.budget:
                self.kept[index], self.used = pixels, self.used + size
        rgb, mask = pixels
        if by > 1:
            if mask is None:
                return average(rgb, by).to(self.dtype).div_(255.0), None
            counted = average(mask, by)  # a block has the mean of its pixels that count
            colors = average(rgb.to(self.dtype) * mask[..., None], by) / counted[..., None].clamp_min(1e-6)
            return colors.div_(255.0), counted
        if self.device.type == "cuda" and self.dtype == torch.float32:
            return torch.div(rgb, 255.0), mask  # one kernel instead of two
        return rgb.to(self.dtype).div_(255.0), mask

    def depth(self, index: int) -> Tensor | None:
        """Return what is known of the depth of a photograph, [h, w] in world units with 0 where
        nothing is, or None. Raises InputError if its file cannot be read."""
        if index in self.depths:
            return self.depths[index]
        read = self.capture.depth(index)
        if read is None:
            return None
        depth = upload(read, self.device, self.dtype)
        size, room = depth.numel() * depth.element_size(), self.budget if self.device.type == "cuda" else DEPTHS
        if self.used + size <= room:
            self.depths[index], self.used = depth, self.used + size
        return depth

    def background(self, color: Tensor | None) -> Tensor:
        """Return a background [3] on the device. None is that of the capture, and so is every
        colour where transparent photographs were composited over it."""
        if color is not None and self.capture.alpha_over is None:
            return upload(color, self.device, self.dtype)
        found = self.backgrounds.get(self.capture.background)
        if found is None:
            found = upload(torch.tensor(self.capture.background), self.device, self.dtype)
            self.backgrounds[self.capture.background] = found
        return found

    def prefetch(self, indices: Iterable[int]) -> None:
        """Decode in the background those of these photographs, in this order, that are not here."""
        self.capture.images.prefetch([index for index in indices if index not in self.kept], self.threads)
