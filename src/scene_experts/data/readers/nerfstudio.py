"""Reads nerfstudio captures: transforms.json with intrinsics for all frames or for each."""

from __future__ import annotations

from pathlib import Path, PurePosixPath
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.numbers import shown
from scene_experts.core.reading.source import guarding
from scene_experts.data.depth_maps import DepthFile
from scene_experts.data.readers import transforms
from scene_experts.data.readers.reader import PosedImage, RawCapture, ReadOptions

MILLI = 0.001
"""Units of the capture for a step of a depth map, which nerfstudio takes unless told otherwise."""


class NerfstudioReader:
    """Reads transforms.json with the camera models OPENCV, OPENCV_FISHEYE and pinhole."""

    name = "nerfstudio"
    files = "transforms.json (nerfstudio)"

    def recognise(self, folder: Path) -> bool:
        return (folder / "transforms.json").is_file()

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses, masks, points and the test views that `test_filenames`, or without it
        `val_filenames`, names.

        `options.images` replaces the first folder of every file path. Frames without an image are
        dropped with a warning; names of no frame and absent masks get one too.
        Raises InputError if a file is damaged or no frame is left.
        """
        with guarding(folder, CAPTURE):
            return self._read(folder, options)

    def _read(self, folder: Path, options: ReadOptions) -> RawCapture:
        path = options.model or folder / "transforms.json"
        meta = transforms.read_meta(path)
        warnings: list[str] = []
        held = _held_out(meta, path, warnings)
        images: list[PosedImage | None] = []
        names: list[str] = []
        unmasked: list[str] = []
        undeep: list[str] = []
        paths = [transforms.read_file_path(frame, index, path) for index, frame in enumerate(meta["frames"])]
        files = transforms.find_images(folder, paths, options.images, warnings)
        for frame, stated, (name, image) in zip(meta["frames"], paths, files):
            lens = transforms.read_lens(meta, frame, path, image)
            mask = transforms.find_beside(folder, frame.get("mask_path"))
            if frame.get("mask_path") and image and not mask:
                unmasked.append(str(frame["mask_path"]))
            angle = transforms.read_angle(meta, frame, path) if lens is None else 0.0
            pose = transforms.read_pose(frame, path)
            names.append(name)
            depth = transforms.find_beside(folder, frame.get("depth_file_path"))
            if frame.get("depth_file_path") and depth is None:
                undeep.append(str(frame["depth_file_path"]))
            held_out, file = transforms.to_pure(stated) in held, None if depth is None else DepthFile(depth, MILLI)
            images.append(image and PosedImage(name, image, lens, pose, mask, angle, held_out, file))
        kept = transforms.drop_absent(folder, images, names, warnings)
        if unmasked:
            warnings.append(f"{len(unmasked)} masks that transforms.json names are absent (first: {unmasked[0]}); restore them")
        if undeep:
            warnings.append(f"{len(undeep)} depth maps that transforms.json names are absent (first: {undeep[0]}); restore them")
        points, cloud = transforms.read_points(folder, meta.get("ply_file_path"), warnings) if options.points else (None, None)
        source = "the file that ply_file_path names, or pointcloud.ply,"
        return RawCapture(
            kept,
            points,
            warnings,
            points_source=source,
            cloud=cloud,
            applied=meta.get("applied_transform"),
            applied_scale=meta.get("applied_scale"),
        )


def _held_out(meta: dict[str, Any], path: Path, warnings: list[str]) -> set[PurePosixPath]:
    """Return the file paths of the frames that are held out: those of test_filenames, else of
    val_filenames.

    Adds warnings about names of no frame, about validation frames beside test frames, and about
    frames that train_filenames does not name. Raises InputError for what is no list.
    """
    train, test, val = (_read_names(meta, f"{part}_filenames", path) for part in ("train", "test", "val"))
    key, held = ("test_filenames", test) if test or not val else ("val_filenames", val)
    frames = {transforms.to_pure(frame["file_path"]) for frame in meta["frames"] if isinstance(frame.get("file_path"), str)}
    if strange := sorted(map(str, held - frames)):
        warnings.append(f"{len(strange)} of {len(held)} names in {key} match no frame (first: {strange[0]})")
    if test and (shared := val & frames - test):
        warnings.append(f"the {len(shared)} validation frames are training views, because test_filenames names the held-out ones")
    if train and (more := sorted(map(str, frames - train - test - val))):
        warnings.append(
            f"{len(more)} of {len(frames)} frames are training views, though train_filenames does not name them (first: {more[0]})"
        )
    return held


def _read_names(meta: dict[str, Any], key: str, path: Path) -> set[PurePosixPath]:
    names = meta.get(key) or []
    if not isinstance(names, list):
        raise InputError(f"expected a list as {key} in {path}, found {shown(names)}; restore the file")
    return {transforms.to_pure(name) for name in names if isinstance(name, str)}


READER = NerfstudioReader()
