"""One photograph from its file to the pixels that training sees: decode, turn, undistort, resize, composite, mask.

EXIF orientation: structure-from-motion tools work on the stored pixels, so it is not applied, unless only the turned image has the size
that the camera model states (then the tool had applied it). Masks are in [0, 1], 1 = counts; they come from alpha and from mask files, and
black means "ignore" as in COLMAP.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image, ImageOps, UnidentifiedImageError
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.data.lens import Lens, pinhole_of

Size = tuple[int, int]  # width, height
_ORIENTATION = 0x0112  # EXIF tag; 5 to 8 swap the axes


@dataclass(frozen=True)
class Source:
    """Where one frame comes from and what is done to it."""

    path: Path
    lens: Lens  # of the pixels after turning, at the file's resolution
    size: Size  # the resolution training sees
    mask: Path | None = None
    turn: bool = False  # apply the EXIF orientation
    background: tuple[float, float, float] | None = None  # composite alpha over this; None: alpha is a mask

    @property
    def bytes(self) -> int:
        """Bytes of the decoded frame with a mask."""
        return self.size[0] * self.size[1] * 4


def probe(path: Path) -> tuple[Size, Size]:
    """Stored size of the image at `path` and its size with the EXIF orientation applied. Reads the header only."""
    with _open(path) as image:
        size = image.size
        try:
            turned = image.getexif().get(_ORIENTATION, 1) in (5, 6, 7, 8)
        except (OSError, ValueError, SyntaxError) as error:  # PNG keeps EXIF behind the pixels: a file cut short fails here
            raise _unreadable(path, error) from error
    return size, (size[1], size[0]) if turned else size


def _open(path: Path) -> Image.Image:
    try:
        return Image.open(path)
    except FileNotFoundError:
        raise InputError(f"expected an image at {path}, found no such file; restore it or remove it from the capture") from None
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> InputError:
    return InputError(f"expected a readable image at {path}, found one that is not ({error}); replace it or remove it from the capture")


def target_size(policy: str, size: Size) -> Size:
    """Width and height that resolution `policy` makes of an image of `size`.

    "as-is" and "inria:N" (which reads the folder images_N) keep it; "cap1600" caps the width at 1600 px, sizes cut to whole pixels as
    Scaffold-GS does; "factor:N" divides by N and rounds; "longest:N" caps the longer side at N px; "share:S" takes S of what "cap1600"
    gives, 16 px of the longer side at least. Nothing is ever enlarged.
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
    """`policy` with "auto" resolved to "cap1600". Raises InputError for one that does not exist."""
    if policy in ("auto", "cap1600", "as-is"):
        return "cap1600" if policy == "auto" else policy
    kind, _, number = policy.partition(":")
    try:
        good = (kind == "factor" and float(number) >= 1) or (kind == "share" and 0 < float(number) <= 1)
        good = good or (kind in ("longest", "inria") and int(number) >= 1)
    except ValueError:
        good = False
    if not good:
        raise InputError(
            f"expected --resolution auto, as-is, cap1600, factor:N, longest:N or inria:N with N >= 1, or share:S with S in (0, 1], "
            f"found {policy!r}; choose one"
        )
    return policy


def decode(source: Source) -> tuple[Tensor, Tensor | None]:
    """The frame of `source`: rgb [H, W, 3] uint8 and its mask [H, W] uint8 (255 = counts) or None where every pixel counts.

    Order: undistort at the file's resolution, then resize (Pillow's antialiased bicubic, as the reference codes), then composite in float
    and round. A pure function of the files. Raises InputError for a file that is unreadable or not of the expected size.
    """
    image = _pixels(source)
    mask = _mask_file(source)
    rgb = image.convert("RGB") if image.mode == "L" else image
    outside = None
    if source.lens.distorted:
        rgb = _remap(rgb, source.lens)
        mask = None if mask is None else _remap(_sized(mask, (source.lens.width, source.lens.height)), source.lens)
        outside = _outside(source.lens)
    if rgb.size != source.size:
        rgb = rgb.resize(source.size, Image.Resampling.BICUBIC)
    weights = [np.asarray(_sized(m, source.size)) for m in (mask, outside) if m is not None]
    pixels = np.asarray(rgb)
    if rgb.mode == "RGBA":
        alpha = pixels[..., 3]
        if source.background is None:
            weights.append(alpha)
            pixels = pixels[..., :3]
        else:
            a = alpha[..., None].astype(np.float32) / 255
            over = pixels[..., :3] * a + np.asarray(source.background, np.float32) * 255 * (1 - a)
            pixels = np.clip(np.rint(over), 0, 255).astype(np.uint8)
    return torch.from_numpy(np.array(pixels, order="C")), _product(weights)


def _product(weights: list[NDArray[np.uint8]]) -> Tensor | None:
    weights = [w for w in weights if w.min() < 255]
    if not weights:
        return None
    out = weights[0].astype(np.float32)
    for w in weights[1:]:
        out = out * w / 255
    return torch.from_numpy(np.rint(out).astype(np.uint8))


def _sized(mask: Image.Image, size: Size) -> Image.Image:
    """`mask` at `size`: the share of each new pixel that counts."""
    return mask if mask.size == size else mask.resize(size, Image.Resampling.BOX)


def _pixels(source: Source) -> Image.Image:
    """The stored picture as 8-bit L, RGB or RGBA, turned where asked."""
    with _open(source.path) as image:
        try:
            image.load()
            out = to_8_bit(ImageOps.exif_transpose(image) if source.turn else image)
        except (OSError, ValueError, SyntaxError) as error:  # Pillow's decoders raise all three for damaged files
            raise _unreadable(source.path, error) from error
    expected = (source.lens.width, source.lens.height)
    if out.size != expected:
        raise InputError(f"expected {source.path} to be {expected[0]}x{expected[1]}, found {out.size[0]}x{out.size[1]}; load it again")
    return out


def to_8_bit(image: Image.Image) -> Image.Image:
    """A picture of any of Pillow's modes as L, RGB or RGBA."""
    if image.mode.startswith("I") or image.mode == "F":  # 16-bit grey: Pillow's own conversion would clip at 255
        deep = np.asarray(image).astype(np.float64)
        return Image.fromarray(np.clip(np.rint(deep / 257), 0, 255).astype(np.uint8))
    if image.mode in ("L", "RGB", "RGBA"):
        return image
    return image.convert("RGBA" if "transparency" in image.info or image.mode in ("LA", "PA", "La", "RGBa") else "RGB")


def _mask_file(source: Source) -> Image.Image | None:
    """The mask file as L, at its own size; lying where the photograph was turned, it is turned as its own EXIF or the photograph's says."""
    if source.mask is None:
        return None
    with _open(source.mask) as image:
        try:
            out = mask_of(image)
        except (OSError, ValueError, SyntaxError) as error:
            raise _unreadable(source.mask, error) from error
    if not source.turn or (out.width > out.height) == (source.lens.width > source.lens.height):
        return out
    exif = out.getexif()
    if exif.get(_ORIENTATION, 1) == 1:
        with _open(source.path) as photograph:
            exif[_ORIENTATION] = photograph.getexif().get(_ORIENTATION, 1)
    return ImageOps.exif_transpose(out)


def mask_of(image: Image.Image) -> Image.Image:
    """What a mask file says, as L (255: counts): its alpha where all its colours are black, else its brightness."""
    return image.getchannel("A") if image.mode == "RGBA" and image.convert("L").getextrema() == (0, 0) else image.convert("L")


@functools.lru_cache(maxsize=2)  # neighbours in a capture share their camera
def _grid(lens: Lens) -> Tensor:
    """Where each pixel of the undistorted image looks in the photograph: [h, w, 2] float32 in grid_sample's [-1, 1]."""
    pinhole = pinhole_of(lens)
    out = np.empty((pinhole.height, pinhole.width, 2), np.float32)
    u = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    for top in range(0, pinhole.height, 64):  # strips keep the float64 temporaries small
        v = (np.arange(top, min(top + 64, pinhole.height)) + 0.5 - pinhole.cy) / pinhole.fy
        du, dv = lens.distort(*np.meshgrid(u, v))
        out[top : top + 64, :, 0] = (du * lens.fx + lens.cx) * 2 / lens.width - 1
        out[top : top + 64, :, 1] = (dv * lens.fy + lens.cy) * 2 / lens.height - 1
    return torch.from_numpy(out)


def _remap(image: Image.Image, lens: Lens) -> Image.Image:
    """Undistort `image` bilinearly; where the photograph ends its border is continued."""
    pixels = np.array(image)
    planes = torch.from_numpy(pixels.reshape(*pixels.shape[:2], -1)).permute(2, 0, 1)[None].float()
    grid = _grid(lens)
    strips = [
        torch.nn.functional.grid_sample(planes, grid[None, top : top + 256], padding_mode="border", align_corners=False)[0].round().byte()
        for top in range(0, grid.shape[0], 256)
    ]
    return Image.fromarray(torch.cat(strips, 1).permute(1, 2, 0).squeeze(-1).numpy(), image.mode)


def _outside(lens: Lens) -> Image.Image | None:
    """Black where the undistorted image looks past the photograph's edge, or None where it nowhere does."""
    inside = (_grid(lens).abs() <= 1).all(-1)
    return None if bool(inside.all()) else Image.fromarray(inside.numpy().astype(np.uint8) * 255)
