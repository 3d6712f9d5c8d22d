"""Turns the values of a photograph into 8-bit sRGB: deep and floating-point values, colour
profiles. Looks at a sample of a capture's photographs first, because one rule must hold for all."""

from __future__ import annotations

import functools
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageCms

from scene_experts.core.errors import InputError, few
from scene_experts.core.reading.budget import PHOTOGRAPH
from scene_experts.core.reading.deep_colors import COLOR16, describe_mode, read_deep_colors
from scene_experts.core.reading.pictures import ORIENTATION, opening_picture

DEPTHS = (255.0, 1023.0, 4095.0, 16383.0, 65535.0)  # white of integers with 8, 10, 12, 14 and 16 bits
LOOKED_AT = (16, 4)  # photographs of more than 8 bits, and others, that are looked at
DARK = 8  # of 255; a photograph whose 99th percentile is below is nearly black
SIDE = 256  # px; photographs of 8 bits are looked at from about this size on


@dataclass(frozen=True)
class White:
    """The values of deep photographs that are white in a capture: of grey integers, of grey floats,
    and of colours with 16 bits."""

    integer: float = 65535.0
    real: float = 1.0
    color: float = 65535.0


def is_deep(mode: str) -> bool:
    """Return whether a Pillow mode has more than 8 bits: integers or floats."""
    return mode.startswith("I") or mode == "F"


def lift(image: Image.Image, white: White) -> Image.Image:
    """Return a picture that is not decoded yet, with the 8 bits that matter where the colours of a
    capture fill a part of 16."""
    if white.color >= DEPTHS[-1] or not describe_mode(image).endswith(COLOR16):
        return image
    values = np.clip(np.rint(read_deep_colors(image) * (255 / white.color)), 0, 255).astype(np.uint8)
    out = Image.fromarray(values, image.mode)
    out.getexif()[ORIENTATION] = image.getexif().get(ORIENTATION, 1)
    out.info = {key: value for key, value in image.info.items() if key == "icc_profile"}
    return out


def find_white(photographs: Sequence[tuple[Path, str]]) -> tuple[White, list[str]]:
    """Return the white of a capture's deep photographs, and what a user should know about it and
    about photographs that are nearly black.

    Args:
        photographs: Path and `describe_mode` of each.

    Raises:
        InputError: for integers above 65535, and for floats that go neither to 1 nor to 255 nor to
            65535.
    """
    white, notes = White(), list[str]()
    for kind in ("I", "F"):
        deep = _spread([path for path, mode in photographs if mode.startswith(kind)], LOOKED_AT[0])
        most = max((_largest(path) for path in deep), default=0.0)
        if kind == "I" and most > DEPTHS[-1]:
            raise InputError(
                f"expected integers of at most 16 bits in the photographs beside {deep[0]}, found {most:,.0f}; save them with 16"
            )
        if kind == "I" and 0 < most <= DEPTHS[-2]:
            white = replace(white, integer=next(level for level in DEPTHS if most <= level))
            notes.append(
                f"the 16-bit photographs have values up to {most:,.0f}: {white.integer:,.0f} is read as white; save them with 8 bits if "
                f"they are meant to be that dark"
            )
        elif kind == "F" and most > 0:
            white = replace(white, real=_white_of_floats(most, deep[0]))
    deep = _spread([path for path, mode in photographs if mode.endswith(COLOR16)], LOOKED_AT[0])
    most = max((_largest_color(path) for path in deep), default=0.0)
    if 0 < most <= DEPTHS[-2]:
        white = replace(white, color=next(level for level in DEPTHS if most <= level))
        notes.append(
            f"the photographs with 16-bit colours have values up to {most:,.0f}: {white.color:,.0f} is read as white; save them with "
            f"8 bits if they are meant to be that dark"
        )
    linear = sum(path.suffix.lower() == ".exr" for path, _ in photographs)
    if linear:
        notes.append(f"{linear} EXR photographs are read as linear light: they get the curve of sRGB, and values from 1 on are white")
    plain = _spread([path for path, mode in photographs], LOOKED_AT[1])
    dark = [path.name for path in plain if _is_dark(path, white)]
    if dark:
        notes.append(f"{len(dark)} of the {len(plain)} photographs looked at are nearly black: {few(dark)}; check how they were saved")
    return white, notes


def _white_of_floats(most: float, path: Path) -> float:
    """Return what is white in photographs of floats: 1, also with some overshoot, 255 or 65535."""
    for low, high, white in ((0.0, 2.0, 1.0), (64.0, 255.5, 255.0), (4096.0, 65535.5, 65535.0)):
        if low < most <= high:
            return white
    raise InputError(
        f"expected floats up to 1, 255 or 65535 in the photographs beside {path}, found {most:.6g}; save them with 8 or 16 bits, or as EXR"
    )


def _spread(paths: list[Path], count: int) -> list[Path]:
    return paths[:: max(1, -(-len(paths) // count))]


def _largest(path: Path) -> float:
    with opening_picture(path, PHOTOGRAPH, heic=True) as image:
        values = np.asarray(image)
    return float(np.nan_to_num(values.astype(np.float64), posinf=0.0).max())


def _largest_color(path: Path) -> float:
    """Return the largest value of colours with 16 bits, exact where it is below a quarter of the
    range."""
    with opening_picture(path, PHOTOGRAPH) as image, opening_picture(path, PHOTOGRAPH) as whole:
        upper = int(np.asarray(image)[..., :3].max())
        return float(read_deep_colors(whole)[..., :3].max()) if upper < 64 else 256.0 * upper


def _is_dark(path: Path, white: White) -> bool:
    with opening_picture(path, PHOTOGRAPH, heic=True) as image:
        image = lift(image, white)
        image.draft(None, (SIDE, SIDE))
        grey = image if is_deep(image.mode) else image.convert("L").reduce(max(1, min(image.size) // SIDE))
        return float(np.percentile(np.asarray(to_8_bit(grey, white)), 99)) < DARK


def to_8_bit(image: Image.Image, white: White | None = None) -> Image.Image:
    """Convert a Pillow image of any mode to L, RGB or RGBA in sRGB.

    white: What is white in deep images; None: what fits the values of this one.
    """
    if is_deep(image.mode):
        deep, out = np.asarray(image), np.empty(image.size[::-1], np.uint8)
        if white is None:
            white = White(real=1.0 if image.mode != "F" or np.nanmax(deep) <= 2 else 255.0 if np.nanmax(deep) <= 255.5 else 65535.0)
        scale = 255 / (white.real if image.mode == "F" else white.integer)
        for top in range(0, len(deep), 256):  # strips keep the float64 temporaries small
            strip = np.nan_to_num(deep[top : top + 256].astype(np.float64))
            out[top : top + 256] = np.clip(np.rint(strip * scale), 0, 255)
        return Image.fromarray(out)
    image = to_srgb(image)
    if image.mode in ("L", "RGB", "RGBA") and "transparency" not in image.info:
        return image
    return image.convert("RGBA" if "transparency" in image.info or image.mode in ("LA", "PA", "La", "RGBa") else "RGB")


def to_srgb(image: Image.Image) -> Image.Image:
    """Convert an image with a colour profile, such as Display P3, to sRGB. A profile that cannot be
    read, and that of a grey image, is ignored as browsers do."""
    profile = image.info.get("icc_profile")
    if not profile or image.mode not in ("RGB", "RGBA", "CMYK") or len(profile) > 1 << 24:
        return image
    transform = _transform(profile, "RGB" if image.mode == "RGBA" else image.mode)
    if transform is None:
        return image
    out = ImageCms.applyTransform(image.convert("RGB") if image.mode == "RGBA" else image, transform)
    assert out is not None
    if image.mode == "RGBA":
        out.putalpha(image.getchannel("A"))
    out.info = {key: value for key, value in image.info.items() if key != "icc_profile"}
    return out


@functools.lru_cache(maxsize=16)
def _transform(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Return the transform from a profile to sRGB, or None for a profile of sRGB and for one that
    cannot be read."""
    try:
        source = ImageCms.ImageCmsProfile(io.BytesIO(profile))
        if "srgb" in ImageCms.getProfileDescription(source).lower():
            return None
        return ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, "RGB", ImageCms.Intent.RELATIVE_COLORIMETRIC)
    except (ImageCms.PyCMSError, OSError, ValueError):
        return None
