"""Frames to disk: a folder of PNG files, or an mp4 through imageio's own ffmpeg; whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.errors import InputError, RunError
from scene_experts.evaluate import pictures
from scene_experts.io import write_atomic

VIDEO = (".mp4", ".mov", ".mkv", ".webm")


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO


def writer() -> Any:
    """The module that encodes. Raises InputError with what to install where it is missing."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError(
            "expected imageio-ffmpeg to write videos, found none; pip install 'scene-experts[video]', or write PNG files (--out FOLDER)"
        ) from error
    return imageio_ffmpeg


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, quality: int = 8) -> int:
    """Encode 8-bit frames [H, W, 3] of one size as H.264 (VP9 for .webm), even sizes by repeating the last row or column; how many.

    quality: 1 to 10. Raises RunError when the encoder fails or the disk is full.
    """
    ffmpeg, count = writer(), 0

    def encode(temporary: Path) -> None:
        nonlocal count
        stream = None
        codec = "libvpx-vp9" if path.suffix.lower() == ".webm" else "libx264"
        container = {".mp4": "mp4", ".mov": "mov", ".mkv": "matroska", ".webm": "webm"}[path.suffix.lower()]
        try:
            for frame in frames:
                even = np.ascontiguousarray(np.pad(frame, ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0)), mode="edge"))
                if stream is None:
                    stream = ffmpeg.write_frames(
                        str(temporary), (even.shape[1], even.shape[0]), fps=fps, codec=codec, quality=quality, macro_block_size=2,
                        ffmpeg_log_level="error", output_params=["-f", container],
                    )  # fmt: skip
                    stream.send(None)
                stream.send(even)
                count += 1
        finally:
            if stream is not None:
                stream.close()

    try:
        write_atomic(path, encode)
    except (OSError, RuntimeError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"cannot write {path}: {error}; free some space, or give a folder as --out for PNG files") from error
    return count


def write_pictures(folder: Path, frames: Iterable[np.ndarray]) -> int:
    """Write frames as 00000.png, 00001.png, ...; frames of an earlier and longer path beyond them go; how many."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"expected a folder for pictures at {folder}, found a file; choose another --out")
    count = 0
    for count, frame in enumerate(frames, 1):
        pictures.write(folder / f"{count - 1:05d}.png", frame)
    for old in folder.glob("[0-9][0-9][0-9][0-9][0-9].png"):
        if int(old.stem) >= count:
            old.unlink()
    return count
