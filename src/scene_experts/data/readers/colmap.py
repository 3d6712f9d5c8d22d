"""Reads COLMAP captures: a reconstruction (sparse/0) beside the folder of its photographs
(images)."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import torch

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.source import guarding
from scene_experts.core.types import Points
from scene_experts.data.match import absent_error, match_images
from scene_experts.data.readers.colmap_model import find_model, read_model
from scene_experts.data.readers.reader import PosedImage, RawCapture, ReadOptions


class ColmapReader:
    """Reads the first reconstruction of a COLMAP workspace, in binary or text form."""

    name = "colmap"
    files = "sparse/0 beside images (COLMAP)"

    def recognise(self, folder: Path) -> bool:
        return find_model(folder) is not None

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses and points.

        Raises InputError if a file of the reconstruction is damaged, an image is listed twice, or
        photographs are absent (with `options.missing == "drop"`: if all are).
        """
        with guarding(folder, CAPTURE):
            return self._read(folder, options)

    def _read(self, folder: Path, options: ReadOptions) -> RawCapture:
        place = find_model(folder)
        assert place is not None
        model = read_model(place)
        names = sorted(image.name for image in model.images)
        twice = next((a for a, b in pairwise(names) if a == b), None)
        if twice is not None:
            raise InputError(f"expected every image once in {place}, found {twice} twice; remove one of its poses")
        photographs = folder / (options.images or "images")
        _check_whole(folder, place, options.images or "images")
        match = match_images(photographs, names)
        warnings = list(match.warnings)
        if match.absent and (options.missing == "error" or not match.found):
            raise absent_error(photographs, names, match.absent)
        if match.absent:
            warnings.append(f"dropped {len(match.absent)} of {len(names)} views because their image is absent (first: {match.absent[0]})")
        warnings += _other_reconstructions(place)
        images = []
        for image in sorted(model.images, key=lambda i: i.name):
            if image.name in match.found:
                images.append(PosedImage(image.name, match.found[image.name], model.cameras[image.camera_id], image.world_to_cam()))
        points = Points(torch.from_numpy(model.xyz), torch.from_numpy(model.rgb)) if len(model.xyz) else None
        return RawCapture(images, points, warnings, points_source="points3D.bin or points3D.txt")


def _check_whole(folder: Path, place: Path, images: str) -> None:
    """Raise InputError if `folder` is the reconstruction itself, not the folder that contains it
    and the photographs."""
    above = next((p for p in (folder.absolute().parent, folder.absolute().parent.parent) if (p / images).is_dir()), None)
    if not (folder / images).is_dir() and above is not None and place.samefile(folder):
        raise InputError(
            f"expected the folder of a capture, found only its reconstruction {folder}; give the folder that contains it: {above}"
        )


def _other_reconstructions(place: Path) -> list[str]:
    """Return a warning if COLMAP split the photographs into several reconstructions."""
    if place.name != "0":
        return []
    others = [p for p in place.parent.iterdir() if p.is_dir() and p.name.isdecimal() and p.name != "0"]
    note = f"{place.parent.name}/ holds {len(others) + 1} reconstructions that COLMAP could not join; only 0 is used"
    return [note] if others else []


READER = ColmapReader()
