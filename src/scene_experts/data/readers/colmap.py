"""Reads COLMAP captures: a reconstruction (sparse/0) beside the folder of its photographs
(images)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path, PurePosixPath

import numpy as np

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.source import guarding
from scene_experts.core.types import Points
from scene_experts.data.equirectangular import VIEWS
from scene_experts.data.lens import PANORAMA, view_of_panorama
from scene_experts.data.match import absent_error, match_images
from scene_experts.data.points import find_cloud, from_arrays, read_points
from scene_experts.data.readers.colmap_model import Model, count_images, find_models, holds_model, read_model
from scene_experts.data.readers.ply import count_points
from scene_experts.data.readers.reader import PosedImage, RawCapture, ReadOptions


class ColmapReader:
    """Reads the largest reconstruction of a COLMAP workspace, in binary or text form."""

    name = "colmap"
    files = "sparse/0 beside images (COLMAP)"

    def recognise(self, folder: Path) -> bool:
        return bool(find_models(folder))

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses and points of the reconstruction with the most photographs, or of
        `options.model`.

        Raises InputError if a file of the reconstruction is damaged, an image is listed twice, or
        photographs are absent (with `options.missing == "drop"`: if all are).
        """
        with guarding(folder, CAPTURE):
            return self._read(folder, options)

    def _read(self, folder: Path, options: ReadOptions) -> RawCapture:
        place, warnings = _choose(folder, options.model)
        model = read_model(place, points=options.points)
        names = sorted(image.name for image in model.images)
        twice = next((a for a, b in pairwise(names) if a == b), None)
        if twice is not None:
            raise InputError(f"expected every image once in {place}, found {twice} twice; remove one of its poses")
        photographs = folder / (options.images or "images")
        _check_whole(folder, place, options.images or "images")
        match = match_images(photographs, names)
        warnings += match.warnings
        if match.absent and (options.missing == "error" or not match.found):
            raise absent_error(photographs, names, match.absent)
        if match.absent:
            warnings.append(f"dropped {len(match.absent)} of {len(names)} views because their image is absent (first: {match.absent[0]})")
        images = []
        for image in sorted(model.images, key=lambda i: i.name):
            if image.name in match.found:
                posed = PosedImage(image.name, match.found[image.name], model.cameras[image.camera_id], image.world_to_cam())
                images += cut_views(posed) if model.cameras[image.camera_id].model == PANORAMA else [posed]
        if len(images) > len(match.found):
            warnings.append(f"{len(images)} views are cut out of the 360 degree panoramas, {len(VIEWS)} of each, while they are read")
        points, cloud = _read_points(folder, place, model, warnings) if options.points else (None, None)
        source = "points3D.bin, points3D.txt or points3D.ply"
        return RawCapture(images, points, warnings, points_source=source, cloud=cloud, model=place)


def _check_whole(folder: Path, place: Path, images: str) -> None:
    """Raise InputError if `folder` is the reconstruction itself, not the folder that contains it
    and the photographs."""
    above = next((p for p in (folder.absolute().parent, folder.absolute().parent.parent) if (p / images).is_dir()), None)
    if not (folder / images).is_dir() and above is not None and place.samefile(folder):
        raise InputError(
            f"expected the folder of a capture, found only its reconstruction {folder}; give the folder that contains it: {above}"
        )


def _choose(folder: Path, model: Path | None) -> tuple[Path, list[str]]:
    """Return the folder of the reconstruction that is read, and a warning if there are others.

    Raises InputError if `model` holds none.
    """
    found = find_models(folder)
    if model is not None:
        if not holds_model(model):
            have = ", ".join(_name(folder, place) for place in found) or "none"
            raise InputError(f"expected a reconstruction in {model}, found none; choose one of {folder} with --model (it has: {have})")
        return model, []
    if len(found) == 1:
        return found[0], []
    counts = [count_images(place) for place in found]
    best = counts.index(max(counts))
    sizes = ", ".join(f"{_name(folder, place)} has {count} photographs" for place, count in zip(found, counts))
    others = _name(folder, found[1 if best == 0 else 0])
    chosen = _name(folder, found[best])
    note = f"the folder holds {len(found)} reconstructions ({sizes}); {chosen} is read; choose another with --model {others}"
    return found[best], [note]


def _name(folder: Path, place: Path) -> str:
    return place.relative_to(folder).as_posix()


def _read_points(folder: Path, place: Path, model: Model, warnings: list[str]) -> tuple[Points | None, Path | None]:
    """Return the points of the model's own file, or without any, those of a PLY file in its folder
    or in that of the capture, and that file."""
    own = model.points_file
    if len(model.xyz):
        cloud = find_cloud([place], [])
        count = None if cloud is None else count_points(cloud)
        if cloud is not None and own is not None and count is not None and count != len(model.xyz):
            warnings.append(
                f"the points are those of {own.name} ({len(model.xyz):,}), not of {cloud.name} ({count:,}); choose the others with "
                f"--points {cloud}"
            )
        warnings += model.notes
        return from_arrays(model.xyz, model.rgb), None
    cloud = find_cloud([place, folder], warnings)
    if cloud is None:
        return None, None
    points = read_points(cloud, warnings)
    why = f"{own.name} is empty" if own else "points3D.bin and points3D.txt are absent"
    warnings.append(
        f"the points are those of {cloud.name} ({0 if points is None else len(points.xyz):,}): {why}; choose others with --points"
    )
    return points, cloud


READER = ColmapReader()


def cut_views(posed: PosedImage) -> list[PosedImage]:
    """Return the perspective views of a panorama, named NAME/VIEW.EXTENSION."""
    assert posed.lens is not None
    views, name = [], PurePosixPath(posed.name)
    for view in VIEWS:
        turn = np.eye(4)
        turn[:3, :3] = view.rig_from_view.T
        called = str(name.with_suffix("") / f"{view.folder}{name.suffix}")
        views.append(replace(posed, name=called, lens=view_of_panorama(posed.lens, view), world_to_cam=turn @ posed.world_to_cam))
    return views
