"""The pictures of an evaluation on disk: renders, photographs, errors and the three beside each other, each expert alone, as 8-bit PNG."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic
from scene_experts.training.run_folder import PICTURES

WORST = 0.25  # mean absolute error over RGB that is drawn brightest; the same for all views, so that they compare
GAP, BAR, TYPE = 4, 22, 13  # px between the pictures, of the caption above them, and of its type
PAGE = 1200  # px; a wider row is likely shown at this width, so its captions are set larger
# evenly spaced, dark to light
HEAT = ((0, 0, 0), (40, 12, 84), (120, 28, 109), (200, 64, 62), (246, 141, 32), (252, 206, 80), (255, 255, 236))
PAPER, INK = (255, 255, 255), (40, 40, 40)


def to_8bit(image: Tensor) -> np.ndarray:
    """[H, W, 3] RGB -> uint8: clamped to [0, 1], x * 255 + 0.5, truncated."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def from_8bit(pixels: np.ndarray) -> Tensor:
    """uint8 [...] -> float32 / 255."""
    return torch.from_numpy(pixels).float() / 255.0


def file_names(views: Iterable[str]) -> dict[str, str]:
    """The picture's relative name for each view's: the extension becomes .png, and is kept before it where two views differ by it alone."""
    views = list(views)
    plain = {view: str(PurePosixPath(view.replace("\\", "/")).with_suffix("")) for view in views}
    folded = [name.casefold() for name in plain.values()]  # some file systems ignore case
    return {view: f"{name if folded.count(name.casefold()) == 1 else view}.png" for view, name in plain.items()}


def clear(folder: Path) -> None:
    """Remove the pictures of an earlier evaluation."""
    for name in PICTURES:
        shutil.rmtree(folder / name, ignore_errors=True)


def write(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [H, W, 3] or [H, W] as PNG, atomically."""
    write_atomic(path, lambda temporary: Image.fromarray(pixels).save(temporary, format="PNG", compress_level=3))


def read(path: Path, mode: str = "RGB") -> np.ndarray:
    """The uint8 pixels of a picture. Raises InputError where it is gone or unreadable."""
    try:
        with Image.open(path) as picture:
            return np.array(picture.convert(mode))
    except OSError as error:
        raise InputError(f"expected a picture at {path}, found none that can be read ({error}); evaluate again") from error


def narrowed(pixels: np.ndarray, widest: int) -> np.ndarray:
    """uint8 [H, W, 3], made smaller where it is wider than `widest` px."""
    h, w = pixels.shape[:2]
    if w <= widest:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize((widest, max(1, round(h * widest / w))), Image.Resampling.LANCZOS))


def heat(error: np.ndarray) -> np.ndarray:
    """Errors [H, W] in colours, uint8 [H, W, 3]: black at 0, white at `WORST` and beyond."""
    place = np.clip(error / WORST, 0, 1) * (len(HEAT) - 1)
    stops = np.asarray(HEAT, dtype=np.float32)
    return np.stack([np.interp(place, np.arange(len(HEAT)), stops[:, c]) for c in range(3)], axis=-1).round().astype(np.uint8)


def error_map(render: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """The mean absolute difference over RGB in colours; where the mask counts nothing, black."""
    error = np.abs(render.astype(np.float32) - photo.astype(np.float32)).mean(axis=2) / 255
    return heat(error if mask is None else error * (mask.astype(np.float32) / 255))


def side_by_side(photo: np.ndarray, render: np.ndarray, errors: np.ndarray, captions: tuple[str, str, str]) -> np.ndarray:
    """Photograph, render and errors in a row with thin gaps, each under its caption."""
    width = photo.shape[1]
    sheet = _row((photo, render, errors), captions)
    _scale(ImageDraw.Draw(sheet), sheet.width, width)
    return np.asarray(sheet)


def row(parts: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """Pictures of one size beside each other, each under its caption, which can be read at `PAGE` px too."""
    return np.asarray(_row(parts, captions, max(1.0, len(parts) * parts[0].shape[1] / PAGE)))


def _row(parts: Sequence[np.ndarray], captions: Sequence[str], scale: float = 1.0) -> Image.Image:
    h, w = parts[0].shape[:2]
    bar = round(BAR * scale)
    sheet = Image.new("RGB", (len(parts) * (w + GAP) - GAP, bar + h), PAPER)
    draw = ImageDraw.Draw(sheet)
    for i, (pixels, caption) in enumerate(zip(parts, captions)):
        left = i * (w + GAP)
        sheet.paste(Image.fromarray(pixels), (left, bar))
        text, font = _fit(draw, caption, w - 8, round(TYPE * scale))
        draw.text((left + 4, bar // 2), text, fill=INK, font=font, anchor="lm")
    return sheet


def _fit(draw: ImageDraw.ImageDraw, text: str, room: int, largest: int) -> tuple[str, ImageFont.ImageFont | ImageFont.FreeTypeFont]:
    """`text` in the largest type of 9 to `largest` px in which it fits, without its last parts (two spaces apart) where it never does."""
    parts, font = text.split("  "), ImageFont.load_default(9)
    while True:
        for size in range(largest, 8, -1):
            font = ImageFont.load_default(size)
            if draw.textlength("  ".join(parts), font=font) <= room:
                return "  ".join(parts), font
        if len(parts) == 1:
            return "", font
        parts.pop()


def _scale(draw: ImageDraw.ImageDraw, right: int, width: int) -> None:
    """The colours from 0 to `WORST` at the right end of the caption bar, where there is room beside the caption."""
    length = min(90, width // 4)
    if length < 40:
        return
    colours = heat(np.linspace(0, WORST, length)[None])[0]
    for x, colour in enumerate(colours):
        draw.line([(right - length + x, 5), (right - length + x, BAR - 6)], fill=tuple(int(c) for c in colour))
    draw.rectangle([right - length - 1, 4, right - 1, BAR - 5], outline=INK)


def strip(pictures: Sequence[Tensor], gap: int = 4) -> Tensor:
    """Pictures [H, W, 3] of one height beside each other, [H, W', 3], a white gap between them."""
    white = torch.ones(pictures[0].shape[0], gap, 3)
    parts = [part for picture in pictures for part in (white, picture.cpu())]
    return torch.cat(parts[1:], dim=1)
