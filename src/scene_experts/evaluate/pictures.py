"""The pictures of an evaluation as 8-bit PNG files: renders, photographs, error maps, comparisons,
and captioned rows."""

from __future__ import annotations

import itertools
import os
import shutil
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from torch import Tensor

from scene_experts.core.io import locked, write_atomic
from scene_experts.core.reading.budget import PICTURE
from scene_experts.core.reading.pictures import opening_picture
from scene_experts.native.library import count_cores
from scene_experts.training.run_folder import PICTURES

MOST_THREADS, PENDING = 8, 16  # that encode pictures, and views that wait for them
WORST = 0.25  # mean absolute error over RGB at the bright end of the error map, the same for all views
GAP, BAR, TYPE = 4, 22, 13  # px: gap between pictures, height of the caption bar, font size
PAGE = 1200  # px; wider rows are likely shown at this width, so their captions are larger
# colours of the error map, evenly spaced from dark to light
HEAT = ((0, 0, 0), (40, 12, 84), (120, 28, 109), (200, 64, 62), (246, 141, 32), (252, 206, 80), (255, 255, 236))
PAPER, INK = (255, 255, 255), (40, 40, 40)


def to_8bit(image: Tensor) -> np.ndarray:
    """Convert an image [H, W, 3] to uint8: clamp to [0, 1], compute x * 255 + 0.5, truncate."""
    return (image.detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def from_8bit(pixels: np.ndarray) -> Tensor:
    """Convert uint8 pixels [...] to float32 in [0, 1]."""
    return torch.from_numpy(pixels).float() / 255.0


def make_file_names(views: Iterable[str]) -> dict[str, str]:
    """Return the relative name of the picture of each view.

    The extension becomes .png. It is kept before .png if two views differ only by their extensions,
    and a number is added if this is the name of another picture.
    """
    views = list(views)
    plain = {view: str(PurePosixPath(view.replace("\\", "/")).with_suffix("")) for view in views}
    folded = [name.casefold() for name in plain.values()]  # some file systems ignore case
    found: dict[str, str] = {}
    taken = {name for name in folded if folded.count(name) == 1}
    for view, name in plain.items():
        if folded.count(name.casefold()) > 1:
            base = view.replace("\\", "/")
            tries = itertools.chain([base], (f"{base}-{number}" for number in itertools.count(2)))
            name = next(each for each in tries if each.casefold() not in taken)
            taken.add(name.casefold())
        found[view] = f"{name}.png"
    return found


def remove_pictures(folder: Path) -> None:
    """Remove the pictures of an earlier evaluation."""
    for name in PICTURES:
        shutil.rmtree(folder / name, ignore_errors=True)


@contextmanager
def replacing(folder: Path, first: bool = True) -> Iterator[Path]:
    """Context manager that yields an empty folder for new pictures. At its end they replace those
    in `folder`.

    After an error the pictures in `folder` are unchanged and the new ones are removed.
    first: Whether this process owns the folder; others only write into it.

    Raises InputError if another evaluation writes beside `folder`.
    """
    new = folder.with_name(f".{folder.name}.part")
    if not first:
        yield new
        return
    new.parent.mkdir(parents=True, exist_ok=True)
    lock = new.with_name(".eval.lock")
    with locked(lock, f"another evaluation writes to {folder.parent}; wait until it ends"):
        shutil.rmtree(new, ignore_errors=True)
        try:
            yield new
            remove_pictures(folder)
            folder.mkdir(parents=True, exist_ok=True)
            for name in PICTURES:
                if (new / name).is_dir():
                    os.replace(new / name, folder / name)
        finally:
            shutil.rmtree(new, ignore_errors=True)
            with suppress(OSError):  # Windows removes no open file
                lock.unlink()


def write_picture(path: Path, pixels: np.ndarray, sync: bool = True) -> None:
    """Write uint8 pixels [H, W, 3] or [H, W] as a PNG file, atomically; `sync`: to the disk."""
    write_atomic(path, lambda temporary: Image.fromarray(pixels).save(temporary, format="PNG", compress_level=1), sync)


def write_floats(path: Path, values: np.ndarray) -> None:
    """Write float32 values [H, W] as a TIFF file of 32-bit floats, atomically."""
    write_atomic(path, lambda temporary: Image.fromarray(values).save(temporary, format="TIFF"))


class Writer:
    """Context manager that draws, encodes and writes pictures in threads, at most PENDING views
    ahead. Raises what a thread raised, at a later call or at the end."""

    def __init__(self) -> None:
        self._threads = ThreadPoolExecutor(min(MOST_THREADS, count_cores()), "scene-experts pictures")
        self._pending: deque[Future[None]] = deque()

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self._threads.shutdown(cancel_futures=True)

    def finish(self) -> None:
        """Wait until all pictures are written."""
        while self._pending:
            self._pending.popleft().result()

    def submit(self, work: Callable[[], None]) -> None:
        """Call `work`, which writes pictures, in a thread."""
        if len(self._pending) >= PENDING:
            self._pending.popleft().result()
        self._pending.append(self._threads.submit(work))


def read_picture(path: Path, mode: str = "RGB") -> np.ndarray:
    """Return the uint8 pixels of a picture. Raises InputError if it is absent or unreadable."""
    with opening_picture(path, PICTURE) as picture:
        return np.array(picture.convert(mode))


def limit_width(pixels: np.ndarray, widest: int) -> np.ndarray:
    """Scale uint8 pixels [H, W, 3] down if they are wider than `widest` px."""
    h, w = pixels.shape[:2]
    if w <= widest:
        return pixels
    return np.asarray(Image.fromarray(pixels).resize((widest, max(1, round(h * widest / w))), Image.Resampling.LANCZOS))


def color_errors(error: np.ndarray) -> np.ndarray:
    """Map errors [H, W] to colours, uint8 [H, W, 3]: black at 0, white from `WORST`."""
    place = np.clip(error / WORST, 0, 1) * (len(HEAT) - 1)
    stops = np.asarray(HEAT, dtype=np.float32)
    return np.stack([np.interp(place, np.arange(len(HEAT)), stops[:, c]) for c in range(3)], axis=-1).round().astype(np.uint8)


def draw_error_map(render: np.ndarray, photo: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Draw the mean absolute difference over RGB, uint8 [H, W, 3]. Pixels that the mask excludes
    are black."""
    error = np.abs(render.astype(np.float32) - photo.astype(np.float32)).mean(axis=2) / 255
    return color_errors(error if mask is None else error * (mask.astype(np.float32) / 255))


def compose_comparison(photo: np.ndarray, render: np.ndarray, errors: np.ndarray, captions: tuple[str, str, str]) -> np.ndarray:
    """Compose photograph, render and error map in a row, each with a caption and the last with a
    colour scale."""
    width = photo.shape[1]
    sheet = _draw_row((photo, render, errors), captions)
    _draw_scale(ImageDraw.Draw(sheet), sheet.width, width)
    return np.asarray(sheet)


def compose_row(parts: Sequence[np.ndarray], captions: Sequence[str]) -> np.ndarray:
    """Compose pictures of one size in a row, each with a caption that is legible when the row is
    shown `PAGE` px wide."""
    return np.asarray(_draw_row(parts, captions, max(1.0, len(parts) * parts[0].shape[1] / PAGE)))


def _draw_row(parts: Sequence[np.ndarray], captions: Sequence[str], scale: float = 1.0) -> Image.Image:
    h, w = parts[0].shape[:2]
    bar = round(BAR * scale)
    sheet = Image.new("RGB", (len(parts) * (w + GAP) - GAP, bar + h), PAPER)
    draw = ImageDraw.Draw(sheet)
    for i, (pixels, caption) in enumerate(zip(parts, captions)):
        left = i * (w + GAP)
        sheet.paste(Image.fromarray(pixels), (left, bar))
        text, font = _fit_text(draw, caption, w - 8, round(TYPE * scale))
        draw.text((left + 4, bar // 2), text, fill=INK, font=font, anchor="lm")
    return sheet


def _fit_text(draw: ImageDraw.ImageDraw, text: str, room: int, largest: int) -> tuple[str, ImageFont.ImageFont | ImageFont.FreeTypeFont]:
    """Return the text and the largest font of 9 to `largest` px in which it fits.

    Parts of a text are separated by two spaces; the last parts are dropped if the text does not fit
    at 9 px.
    """
    parts, font = text.split("  "), ImageFont.load_default(9)
    while True:
        for size in range(largest, 8, -1):
            font = ImageFont.load_default(size)
            if draw.textlength("  ".join(parts), font=font) <= room:
                return "  ".join(parts), font
        if len(parts) == 1:
            return "", font
        parts.pop()


def _draw_scale(draw: ImageDraw.ImageDraw, right: int, width: int) -> None:
    """Draw the colours from 0 to `WORST` at the right end of the caption bar, if there is room
    beside the caption."""
    length = min(90, width // 4)
    if length < 40:
        return
    colours = color_errors(np.linspace(0, WORST, length)[None])[0]
    for x, colour in enumerate(colours):
        draw.line([(right - length + x, 5), (right - length + x, BAR - 6)], fill=tuple(int(c) for c in colour))
    draw.rectangle([right - length - 1, 4, right - 1, BAR - 5], outline=INK)


def join_pictures(pictures: Sequence[Tensor], gap: int = 4) -> Tensor:
    """Join pictures [H, W, 3] of one height horizontally with white gaps, [H, W', 3]."""
    white = torch.ones(pictures[0].shape[0], gap, 3)
    parts = [part for picture in pictures for part in (white, picture.cpu())]
    return torch.cat(parts[1:], dim=1)
