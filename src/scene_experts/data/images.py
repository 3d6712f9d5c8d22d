"""Turns a photograph file into the pixels that training sees: decode, rotate, undistort, resize,
composite, mask.

`orientation` says whether the EXIF orientation is applied. Masks come from alpha channels and mask
files (`masks`).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import PHOTOGRAPH
from scene_experts.core.reading.deep_colors import describe_mode
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.data.colour import White, lift, to_8_bit
from scene_experts.data.equirectangular import PanoramaView, find_places
from scene_experts.data.lens import PANORAMA_VIEW, Lens, to_pinhole
from scene_experts.data.masks import Mask, read_mask

Size = tuple[int, int]  # width, height
ORIENTATION = 0x0112  # EXIF tag; 5 to 8 swap the axes


@dataclass(frozen=True)
class FrameSource:
    """The file of a frame and the steps that turn it into pixels."""

    path: Path
    lens: Lens  # of the rotated image, at the resolution of the file
    size: Size  # the resolution that training sees
    mask: Mask | None = None
    turn: bool = False  # apply the EXIF orientation
    background: tuple[float, float, float] | None = None  # composite alpha over this RGB in [0, 1]; None: alpha is a mask
    white: White = White()  # of deep photographs

    @property
    def bytes(self) -> int:
        """Size in bytes of the decoded frame with a mask."""
        return self.size[0] * self.size[1] * 4


@dataclass(frozen=True)
class PhotoHeader:
    """What the header of a photograph says."""

    size: Size  # as stored
    orientation: int  # from EXIF, 1 to 8
    mode: str = "RGB"  # of `describe_mode`

    @property
    def turned(self) -> Size:
        """The size with the EXIF orientation applied."""
        return (self.size[1], self.size[0]) if self.orientation >= 5 else self.size


def probe(path: Path) -> PhotoHeader:
    """Read the header of the image at `path`."""
    with opening_picture(path, PHOTOGRAPH) as image:
        size, mode = image.size, describe_mode(image)
        orientation = image.getexif().get(ORIENTATION, 1)  # PNG stores EXIF after the pixels: a truncated file fails here
    return PhotoHeader(size, orientation if orientation in range(1, 9) else 1, mode)


def has_alpha(path: Path) -> bool:
    """Return whether the image at `path` has an alpha channel or a transparent colour."""
    with opening_picture(path, PHOTOGRAPH) as image:
        return "A" in image.getbands() or "transparency" in image.info


def target_size(policy: str, size: Size) -> Size:
    """Return the width and height in px of an image of `size` under the resolution policy `policy`.

    "as-is" and "inria:N" (which reads the folder images_N) keep the size. "cap1600" limits the
    width to 1600 px and truncates to whole pixels, as Scaffold-GS does. "factor:N" divides by N and
    rounds. "longest:N" limits the longer side to N px. "share:S" multiplies the result of "cap1600"
    by S, with a longer side of at least 16 px. No policy enlarges an image.
    """
    w, h = size
    kind, _, number = policy.partition(":")
    if kind in ("as-is", "inria"):
        return size
    if kind == "cap1600":
        scale = w / 1600 if w > 1600 else 1.0
        return max(1, int(w / scale)), max(1, int(h / scale))
    if kind == "factor":
        return max(1, round(w / float(number))), max(1, round(h / float(number)))
    if kind == "share":
        w, h = target_size("cap1600", size)
        scale = max(float(number), min(1.0, 16 / max(w, h)))
    else:
        scale = min(1.0, int(number) / max(w, h))
    return max(1, round(w * scale)), max(1, round(h * scale))


def check_policy(policy: str) -> str:
    """Return `policy`, with "auto" replaced by "cap1600". Raises InputError for an unknown
    policy."""
    if policy in ("auto", "cap1600", "as-is"):
        return "cap1600" if policy == "auto" else policy
    kind, _, number = policy.partition(":")
    try:
        good = (kind == "factor" and float(number) >= 1) or (kind == "share" and 0 < float(number) <= 1)
        good = good or (kind in ("longest", "inria") and int(number) >= 1)
    except ValueError:
        good = False
    if not good:
        meant = f"for a longest side of {policy} pixels write longest:{policy}" if policy.isdecimal() else "choose one"
        raise InputError(
            f"expected --resolution auto, as-is, cap1600, factor:N, longest:N or inria:N with N >= 1, or share:S with S in (0, 1], "
            f"found {policy!r}; {meant}"
        )
    return policy


def decode(source: FrameSource) -> tuple[Tensor, Tensor | None]:
    """Return the frame of `source`: rgb [H, W, 3] uint8 and its mask [H, W] uint8 (255 = counts),
    or None if every pixel counts.

    The photograph is undistorted at the resolution of its file, resized with Pillow's antialiased
    bicubic filter as in the reference codes, then composited in float and rounded. The result
    depends on the files only. Raises InputError if a file is unreadable or does not have the
    expected size.
    """
    image = _load_pixels(source)
    mask = load_mask(source)
    rgb = image.convert("RGB") if image.mode == "L" else image
    outside = None
    if source.lens.distorted:
        rgb = _undistort(rgb, source.lens)
        mask = None if mask is None else _undistort(_resize_mask(mask, (source.lens.width, source.lens.height)), source.lens)
        outside = _make_outside_mask(source.lens)
    if rgb.size != source.size:
        rgb = rgb.resize(source.size, Image.Resampling.BICUBIC)
    weights = [np.asarray(_resize_mask(m, source.size)) for m in (mask, outside) if m is not None]
    pixels = np.asarray(rgb)
    if rgb.mode == "RGBA":
        alpha = pixels[..., 3]
        if source.background is None:
            weights.append(alpha)
            pixels = pixels[..., :3]
        else:
            over, background = np.empty((*alpha.shape, 3), np.uint8), np.asarray(source.background, np.float32) * 255
            for top in range(0, len(alpha), 256):  # strips keep the float32 temporaries small
                a = alpha[top : top + 256, :, None].astype(np.float32) / 255
                over[top : top + 256] = np.clip(np.rint(pixels[top : top + 256, :, :3] * a + background * (1 - a)), 0, 255)
            pixels = over
    return torch.from_numpy(np.array(pixels, order="C")), _multiply(weights)


def _multiply(weights: list[NDArray[np.uint8]]) -> Tensor | None:
    weights = [w for w in weights if w.min() < 255]
    if not weights:
        return None
    out = weights[0].astype(np.float32)
    for w in weights[1:]:
        out = out * w / 255
    return torch.from_numpy(np.rint(out).astype(np.uint8))


def _resize_mask(mask: Image.Image, size: Size) -> Image.Image:
    """Resize `mask`: each new pixel is the fraction of its area that counts."""
    return mask if mask.size == size else mask.resize(size, Image.Resampling.BOX)


def _load_pixels(source: FrameSource) -> Image.Image:
    """Load the photograph as 8-bit L, RGB or RGBA, rotated if `source.turn`."""
    with opening_picture(source.path, PHOTOGRAPH) as image:
        image = lift(image, source.white)
        image.load()
        out = to_8_bit(ImageOps.exif_transpose(image) if source.turn else image, source.white)
    expected = (source.lens.width, source.lens.height)
    if out.size != expected:
        raise InputError(
            f"expected {source.path} with {expected[0]}x{expected[1]} px, found {out.size[0]}x{out.size[1]}; load the capture again"
        )
    return out


def load_mask(source: FrameSource) -> Image.Image | None:
    """Load the mask file as L, at its own size. Raises InputError if it has another aspect ratio
    than the photograph.

    If the photograph was rotated, so is a mask with an EXIF orientation of its own, and by the
    photograph's a mask that has its shape only then.
    """
    if source.mask is None:
        return None
    out = read_mask(source.mask)
    shaped = (out.width > out.height) == (source.lens.width > source.lens.height)
    if source.turn and (not shaped or (out.getexif().get(ORIENTATION, 1) in (2, 3, 4) or out.width == out.height)):
        out = _turn_mask(source, out, shaped)
    if not fits(out.size, (source.lens.width, source.lens.height)):
        raise InputError(
            f"expected the mask {source.mask.path} with the aspect ratio of its photograph ({source.lens.width}x{source.lens.height}), "
            f"found {out.width}x{out.height}; make it of the photograph's pixels as they are stored"
        )
    return out


def fits(size: Size, whole: Size) -> bool:
    """Return whether a picture of `size` is one of `whole` at another scale. Sides are whole
    pixels, so ratios may differ by one."""
    (w, h), (width, height) = size, whole
    return abs(w * height - h * width) <= max(w, h, width, height, 0.01 * w * height)


def _turn_mask(source: FrameSource, out: Image.Image, shaped: bool) -> Image.Image:
    exif = out.getexif()
    if exif.get(ORIENTATION, 1) == 1 and not shaped:
        with opening_picture(source.path, PHOTOGRAPH) as photograph:
            exif[ORIENTATION] = photograph.getexif().get(ORIENTATION, 1)
    return ImageOps.exif_transpose(out)


@functools.lru_cache(maxsize=2)  # neighbouring views share their camera
def make_grid(lens: Lens, size: Size | None = None) -> Tensor:
    """Return where each pixel of the undistorted image lies in the photograph: [h, w, 2] float32 in
    [-1, 1], for grid_sample; 2 where the photograph does not show it.

    size: Width and height of the undistorted image; None is that of the photograph. The views of
    panoramas have one size.
    """
    pinhole = to_pinhole(lens) if size is None else to_pinhole(lens).resize(*size)
    if lens.model == PANORAMA_VIEW:
        view = PanoramaView(round(lens.value("yaw")), round(lens.value("pitch")))
        places = find_places(view, pinhole.width, (lens.width, lens.height))
        return places * torch.tensor([2 / lens.width, 2 / lens.height]) - 1
    out = np.empty((pinhole.height, pinhole.width, 2), np.float32)
    u = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    for top in range(0, pinhole.height, 64):  # strips keep the float64 temporaries small
        v = (np.arange(top, min(top + 64, pinhole.height)) + 0.5 - pinhole.cy) / pinhole.fy
        rays = np.meshgrid(u, v)
        du, dv = lens.distort(*rays)
        out[top : top + 64, :, 0] = (du * lens.fx + lens.cx) * 2 / lens.width - 1
        out[top : top + 64, :, 1] = (dv * lens.fy + lens.cy) * 2 / lens.height - 1
        out[top : top + 64][lens.is_folded(*rays)] = 2  # outside: the photograph does not show these rays
    return torch.from_numpy(out)


def _undistort(image: Image.Image, lens: Lens) -> Image.Image:
    """Undistort `image` with bilinear interpolation. Its border is repeated outside."""
    pixels = np.array(image)
    planes = torch.from_numpy(pixels.reshape(*pixels.shape[:2], -1)).permute(2, 0, 1)[None].float()
    grid = make_grid(lens)
    strips = [
        torch.nn.functional.grid_sample(planes, grid[None, top : top + 256], padding_mode="border", align_corners=False)[0].round().byte()
        for top in range(0, grid.shape[0], 256)
    ]
    return Image.fromarray(torch.cat(strips, 1).permute(1, 2, 0).squeeze(-1).numpy(), image.mode)


def _make_outside_mask(lens: Lens) -> Image.Image | None:
    """Return a mask that is black where the undistorted image exceeds the photograph, or None if it
    nowhere does."""
    inside = (make_grid(lens).abs() <= 1).all(-1)
    return None if bool(inside.all()) else Image.fromarray(inside.numpy().astype(np.uint8) * 255)
