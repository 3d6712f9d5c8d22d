"""Photographs with EXIF data, and a stand-in for COLMAP's process."""

from pathlib import Path

import numpy as np
from PIL import Image


def write_photo(path, size=(40, 30), model="", focal=0.0):
    """Write a black photograph with its name and the camera's model and focal length in its EXIF
    data."""
    path.parent.mkdir(parents=True, exist_ok=True)
    exif = Image.Exif()
    exif[0x010E] = path.name  # no other photograph has its bytes
    if model:
        exif[0x0110] = model
        exif.get_ifd(0x8769)[0x920A] = focal
    Image.fromarray(np.zeros((size[1], size[0], 3), np.uint8)).save(path, exif=exif)
    return path


def write_turned(path, orientation=6, form="JPEG"):
    """Write a photograph with an EXIF orientation; its upper third, as stored, is red."""
    picture, exif = Image.new("RGB", (40, 30)), Image.Exif()
    picture.paste((255, 0, 0), (0, 0, 40, 10))
    exif[0x0112], exif[0x0110] = orientation, "A"
    path.parent.mkdir(parents=True, exist_ok=True)
    picture.save(path, form, exif=exif, quality=95)


def write_black(folder: Path, count: int = 3) -> Path:
    """Write black photographs 0.jpg, 1.jpg, ... to `folder`."""
    for i in range(count):
        write_photo(folder / f"{i}.jpg", size=(64, 48))
    return folder


def fake_worker(**said):
    """A stand-in for COLMAP's process: it writes an empty model, answers with `said` and keeps the requests."""

    def reconstructed(request, log, say, progress):
        reconstructed.requests.append(request)
        model = Path(request["model"])
        model.mkdir(parents=True, exist_ok=True)
        (model / "cameras.bin").write_bytes(b"new")
        return {"step": "done", "version": "0", "registered": [], **said}

    reconstructed.requests = []
    return reconstructed
