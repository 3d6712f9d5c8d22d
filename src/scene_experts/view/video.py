"""Writes frames to disk: a folder of PNG files, or a video with the ffmpeg that imageio
installs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.io import read_json, write_atomic, write_json
from scene_experts.evaluate import pictures

NOTE = "frames.json"
VIDEO = (".mp4", ".mov", ".mkv", ".webm")


def is_video(path: Path) -> bool:
    """Return whether a path has the extension of a video."""
    return path.suffix.lower() in VIDEO


def import_ffmpeg() -> Any:
    """Return the module imageio_ffmpeg. Raises InputError, which says what to install, if it is
    missing."""
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise InputError(
            f"writing videos requires imageio-ffmpeg: {install_line('video')}, or write PNG files with --out FOLDER"
        ) from error
    return imageio_ffmpeg


def write_video(path: Path, frames: Iterable[np.ndarray], fps: float, quality: int = 8) -> int:
    """Encode 8-bit frames [H, W, 3] of one size as H.264 (VP9 for .webm) and return their number.

    Odd sizes become even by repeating the last row or column. The file appears when it is complete.
    quality: 1 to 10. Raises RunError if the encoder fails or the disk is full.
    """
    ffmpeg, count = import_ffmpeg(), 0

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
        if stream is not None and (whole := ffmpeg.count_frames_and_secs(str(temporary))[0]) != count:  # its exit code is not available
            raise RuntimeError(f"only {whole} of {count} frames were encoded")

    try:
        write_atomic(path, encode)
    except (OSError, RuntimeError) as error:
        if isinstance(error, RunError):
            raise
        why = (str(error).strip().splitlines() or [type(error).__name__])[-1]  # ffmpeg's message begins with how it was built
        raise RunError(f"cannot write {path}: {why}; free some space, or give a folder as --out for PNG files") from error
    return count


def write_pictures(
    folder: Path, frames: Iterable[np.ndarray], floats: Callable[[int], np.ndarray] | None = None, names: Sequence[str] = ()
) -> int:
    """Write frames as 00000.png, 00001.png, ... and their number as frames.json, and return their
    number. floats: Returns values [H, W] of a frame, which are written as 00000.tiff. names: The
    photograph of each frame, for frames.json.

    Frames that an earlier call wrote into the folder are replaced. Raises InputError, before the
    first frame is drawn, if the folder holds such pictures from elsewhere.
    """
    if folder.exists() and not folder.is_dir():
        raise InputError(f"expected a folder for pictures, found the file {folder}; choose another --out")
    before, had_floats = _read_earlier(folder)
    earlier, note = [f"{i:05d}" for i in range(before)], folder / NOTE
    for suffix, known in ((".png", earlier), (".tiff", earlier if had_floats else [])):
        foreign = {path.stem for path in folder.glob(f"[0-9][0-9][0-9][0-9][0-9]{suffix}")} - set(known)
        if foreign and (suffix == ".png" or floats is not None):
            raise InputError(f"{folder} holds {min(foreign)}{suffix}, which `render` did not write; choose another --out")
    count = 0
    for count, frame in enumerate(frames, 1):
        if count > before or (floats is not None and not had_floats):
            # first, because a picture without a note counts as foreign
            write_json(note, {"frames": max(count, before), "floats": had_floats or floats is not None})
        pictures.write_picture(folder / f"{count - 1:05d}.png", frame)
        if floats is not None:
            pictures.write_floats(folder / f"{count - 1:05d}.tiff", floats(count - 1))
    for number, name in enumerate(earlier):
        if number >= count:
            (folder / f"{name}.png").unlink(missing_ok=True)
        if had_floats and (number >= count or floats is None):
            (folder / f"{name}.tiff").unlink(missing_ok=True)
    write_json(note, {"frames": count, "floats": floats is not None, **({"photographs": list(names)} if names else {})})
    return count


def _read_earlier(folder: Path) -> tuple[int, bool]:
    """Return the number of pictures that an earlier call wrote into `folder`, and whether it wrote
    files of floats too."""
    try:
        found = read_json(folder / NOTE, "note of the frames")
    except InputError:
        return 0, False
    count = found.get("frames") if isinstance(found, dict) else None
    floats = isinstance(found, dict) and found.get("floats") is True
    return (count, floats) if isinstance(count, int) and 0 <= count < 100_000 else (0, False)
