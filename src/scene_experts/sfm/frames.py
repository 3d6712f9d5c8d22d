"""Extracts the sharpest frames of a video, spread evenly over its motion, with the ffmpeg that
imageio installs."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.extras import install_line
from scene_experts.core.io import write_atomic
from scene_experts.core.progress import Progress

GRADING_WIDTH = 480  # px; frames are scaled to this width before their sharpness is measured
JPEG_QUALITY = 95
NOISE = 0.25  # grey levels, of 255: the mean change that coding makes of a repeated frame, at most
STILL = 0.1  # share of the usual change from frame to frame below which a frame is a copy of the one before


def extract_frames(video: Path, folder: Path, count: int, progress: Progress) -> tuple[list[str], int]:
    """Write about `count` frames of `video` into `folder` as frame_00001.jpg, ...; returns their names
    and how many frames show no motion.

    The video is divided into `count` segments of equal motion, and the sharpest frame of each is
    extracted. Raises InputError if imageio-ffmpeg is missing or ffmpeg cannot decode the file.
    """
    grades, changes, before = [], [], None
    expected, frames = read_frames(video, f"scale={GRADING_WIDTH}:-2,format=gray", "gray", 1)
    for frame in frames:
        gray = frame[..., 0].astype(np.float32)
        grades.append(sharpness(gray))
        changes.append(0.0 if before is None else float(np.abs(gray - before).mean()))
        before = gray
        progress("looking for sharp frames", len(grades), max(expected, len(grades)))
    motion = measure_motion(changes)
    chosen = choose_sharpest(grades, motion, count)
    if not chosen:
        raise InputError(f"expected a video with frames at {video}, found none; convert it to mp4 or extract its frames with another tool")
    names = [f"frame_{i + 1:05d}.jpg" for i in range(len(chosen))]
    folder.mkdir(parents=True, exist_ok=True)
    for i, (name, frame) in enumerate(zip(names, read_frames(video, f"select={select_frames(chosen)}", "rgb24", 3)[1])):
        image = Image.fromarray(frame)
        write_atomic(folder / name, lambda temporary, image=image: image.save(temporary, "JPEG", quality=JPEG_QUALITY, subsampling=0))
        progress("frames", i + 1, len(names))
    return names, motion.count(0.0)


def select_frames(numbers: Sequence[int]) -> str:
    """Return ffmpeg's expression that is true for these frames: a balanced tree, because ffmpeg
    limits the depth of expressions to 100."""
    if len(numbers) == 1:
        return rf"eq(n\,{numbers[0]})"
    middle = len(numbers) // 2
    return f"({select_frames(numbers[:middle])}+{select_frames(numbers[middle:])})"


def measure_motion(changes: Sequence[float]) -> list[float]:
    """Return how much the camera moves from the frame before to each frame, from 0 (not at all) to 1
    (as usual in this video, or more).

    changes: Mean absolute differences of each frame from the one before; the first counts as usual.
    """
    usual = float(np.quantile(changes[1:], 0.75)) if len(changes) > 1 else 0.0
    moved = [change for change in changes[1:] if change > NOISE]
    if usual <= NOISE and moved:  # most frames repeat the one before: pictures of another rate, or of a slide show
        usual = float(np.quantile(moved, 0.75))
    shares = [min(1.0, change / usual) if usual > 0 else 1.0 for change in changes[1:]]
    return [1.0, *(share if share >= STILL else 0.0 for share in shares)][: len(changes)]


def choose_sharpest(grades: Sequence[float], motion: Sequence[float], count: int) -> list[int]:
    """Return the index of the highest grade in each of `count` segments of equal motion, or every
    index with motion if there are fewer."""
    moved = [i for i, share in enumerate(motion) if share > 0]
    if len(moved) <= count:
        return moved
    weight = np.asarray(motion)[moved]
    while weight.max() > 1.0001 * weight.sum() / count:  # no frame may be longer than a segment
        weight = np.minimum(weight, weight.sum() / count)
    segments = ((weight.cumsum() - weight / 2) / weight.sum() * count).astype(int)
    best: dict[int, int] = {}
    for i, segment in zip(moved, segments.tolist()):
        if segment not in best or grades[i] > grades[best[segment]]:
            best[segment] = i
    return list(best.values())


def sharpness(gray: np.ndarray) -> float:
    """Return the variance of the Laplacian of an image [H, W]. Blur lowers it."""
    g = gray.astype(np.float32)
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var())


def read_frames(video: Path, filters: str, pixels: str, channels: int) -> tuple[int, Iterator[np.ndarray]]:
    """Return the approximate number of frames of a video, and the frames [H, W, channels] uint8
    that ffmpeg's `filters` keep.

    No frame is duplicated or dropped. Raises InputError if imageio-ffmpeg is missing or ffmpeg
    cannot decode the file.
    """
    ffmpeg = import_ffmpeg()
    options = ["-vf", filters, "-fps_mode", "passthrough"]
    frames = ffmpeg.read_frames(str(video), pix_fmt=pixels, bpp=channels, bits_per_pixel=8 * channels, output_params=options)

    def guarded() -> Iterator[Any]:
        try:
            yield from frames
        except (OSError, RuntimeError, ValueError) as error:
            why = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
            way = "give a video or a folder of photographs, or convert it to mp4"
            raise InputError(f"cannot decode {video} as a video: {why}; {way}") from error

    stream = guarded()
    facts = next(stream)
    width, height = facts["size"]
    count = int(facts.get("fps", 0) * min(facts.get("duration", 0), 1e6))
    return count, (np.frombuffer(frame, np.uint8).reshape(height, width, channels) for frame in stream)


def import_ffmpeg() -> Any:
    """Return the module imageio_ffmpeg. Raises InputError, which says what to install, if it is
    missing."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError(f"reading videos requires imageio-ffmpeg: {install_line('video')}") from error
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns about the frame size that is requested here
    return imageio_ffmpeg
