"""Frames to disk: a folder of PNG files, or an mp4 through imageio's own ffmpeg; whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import read_json, write_atomic, write_json
from scene_experts.evaluate import pictures

NOTE = "frames.json"
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
        if stream is not None and (whole := ffmpeg.count_frames_and_secs(str(temporary))[0]) != count:  # its exit code is not told
            raise RuntimeError(f"{whole} of {count} frames arrived")

    try:
        write_atomic(path, encode)
    except (OSError, RuntimeError) as error:
        if isinstance(error, RunError):
            raise
        raise RunError(f"cannot write {path}: {error}; free some space, or give a folder as --out for PNG files") from error
    return count


def write_pictures(folder: Path, frames: Iterable[np.ndarray]) -> int:
    """Write frames as 00000.png, 00001.png, ... and how many into frames.json; those of an earlier and longer path go; how many.

    Raises InputError, before the first frame is drawn, for a folder that holds such pictures of somebody else.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"expected a folder for pictures at {folder}, found a file; choose another --out")
    earlier, note = [folder / f"{i:05d}.png" for i in range(_earlier(folder))], folder / NOTE
    foreign = set(folder.glob("[0-9][0-9][0-9][0-9][0-9].png")) - set(earlier)
    if foreign:
        raise InputError(f"expected a folder whose pictures may be replaced at {folder}, found {min(foreign).name}; choose another --out")
    count = 0
    for count, frame in enumerate(frames, 1):
        if count > len(earlier):
            write_json(note, {"frames": count})  # first: a picture without a note would be taken for somebody else's
        pictures.write(folder / f"{count - 1:05d}.png", frame)
    for old in earlier[count:]:
        old.unlink(missing_ok=True)
    write_json(note, {"frames": count})
    return count


def _earlier(folder: Path) -> int:
    """How many pictures an earlier call left in `folder`."""
    try:
        found = read_json(folder / NOTE, "note of the frames")
    except InputError:
        return 0
    count = found.get("frames") if isinstance(found, dict) else None
    return count if isinstance(count, int) and 0 <= count < 100_000 else 0
