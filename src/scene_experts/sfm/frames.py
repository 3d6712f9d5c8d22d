"""A video's sharpest frames, spread evenly over its length, through imageio's own ffmpeg."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_atomic

LOOK = 480  # px: the width at which sharpness is judged
QUALITY = 95
MOST = 5000  # frames: more have no room in one command of ffmpeg's

Told = Callable[[str, int, int], None]


def take(video: Path, folder: Path, count: int, progress: Told) -> list[str]:
    """Write about `count` frames of `video` as frame_00001.jpg, ... into `folder`; returns their names.

    The frames of a video are divided into `count` stretches of the same length, and of each the sharpest is taken.
    Raises InputError where imageio-ffmpeg is missing or the file is no video.
    """
    grades, expected, pictures = [], *read(video, f"scale={LOOK}:-2,format=gray", "gray", 1)
    for picture in pictures:
        grades.append(sharpness(picture[..., 0]))
        progress("looking for sharp frames", len(grades), max(expected, len(grades)))
    chosen = sharpest(grades, count)
    if not chosen:
        raise InputError(f"expected a video with frames at {video}, found none; convert it to mp4 or take its frames by another tool")
    names = [f"frame_{i + 1:05d}.jpg" for i in range(len(chosen))]
    wanted = "+".join(rf"eq(n\,{index})" for index in chosen)
    folder.mkdir(parents=True, exist_ok=True)
    for i, (name, picture) in enumerate(zip(names, read(video, f"select={wanted}", "rgb24", 3)[1])):
        image = Image.fromarray(picture)
        write_atomic(folder / name, lambda temporary, image=image: image.save(temporary, "JPEG", quality=QUALITY, subsampling=0))
        progress("frames", i + 1, len(names))
    return names


def sharpest(grades: Sequence[float], count: int) -> list[int]:
    """The index of the highest grade in each of `count` stretches of the same length; every index where there are fewer."""
    edges = np.linspace(0, len(grades), min(count, len(grades)) + 1).round().astype(int)
    return [int(a + np.argmax(grades[a:b])) for a, b in pairwise(edges)]


def sharpness(gray: np.ndarray) -> float:
    """Variance of the Laplacian of a picture [H, W]: small where motion or focus blurs it."""
    g = gray.astype(np.float32)
    laplacian = g[1:-1, :-2] + g[1:-1, 2:] + g[:-2, 1:-1] + g[2:, 1:-1] - 4 * g[1:-1, 1:-1]
    return float(laplacian.var())


def read(video: Path, filters: str, pixels: str, channels: int) -> tuple[int, Iterator[np.ndarray]]:
    """About how many frames a video has, and those [H, W, channels] uint8 that ffmpeg's `filters` leave, none doubled or dropped.

    Raises InputError where imageio-ffmpeg is missing or the file cannot be read.
    """
    ffmpeg = reader()
    options = ["-vf", filters, "-fps_mode", "passthrough"]
    frames = ffmpeg.read_frames(str(video), pix_fmt=pixels, bpp=channels, bits_per_pixel=8 * channels, output_params=options)

    def guarded() -> Iterator[Any]:
        try:
            yield from frames
        except (OSError, RuntimeError, ValueError) as error:
            why = str(error).strip().splitlines()[-1] if str(error).strip() else type(error).__name__
            raise InputError(f"expected a video that ffmpeg reads at {video}, found one it does not ({why}); convert it to mp4") from error

    stream = guarded()
    facts = next(stream)
    width, height = facts["size"]
    count = int(facts.get("fps", 0) * min(facts.get("duration", 0), 1e6))
    return count, (np.frombuffer(frame, np.uint8).reshape(height, width, channels) for frame in stream)


def reader() -> Any:
    """The module that decodes. Raises InputError with what to install where it is missing."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError("expected imageio-ffmpeg to read videos, found none; pip install 'scene-experts[video]'") from error
    logging.getLogger("imageio_ffmpeg").setLevel(logging.ERROR)  # it warns of the size that we ask it for
    return imageio_ffmpeg
