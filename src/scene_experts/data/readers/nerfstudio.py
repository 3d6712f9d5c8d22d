"""Reads nerfstudio captures: transforms.json with intrinsics for all frames or for each."""

from __future__ import annotations

from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.numbers import shown
from scene_experts.core.reading.source import guarding
from scene_experts.data.match import find_mask
from scene_experts.data.readers import transforms
from scene_experts.data.readers.reader import PosedImage, RawCapture, ReadOptions


class NerfstudioReader:
    """Reads transforms.json with the camera models OPENCV, OPENCV_FISHEYE and pinhole."""

    name = "nerfstudio"
    files = "transforms.json (nerfstudio)"

    def recognise(self, folder: Path) -> bool:
        return (folder / "transforms.json").is_file()

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses, masks, points and the test views that `test_filenames` names.

        `options.images` replaces the first folder of every file path. Frames without an image are dropped with a warning.
        Raises InputError if a file is damaged or no frame is left.
        """
        with guarding(folder, CAPTURE):
            return self._read(folder, options)

    def _read(self, folder: Path, options: ReadOptions) -> RawCapture:
        path = folder / "transforms.json"
        meta = transforms.read_meta(path)
        tests = meta.get("test_filenames") or []
        if not isinstance(tests, list):
            raise InputError(f"expected a list as test_filenames in {path}, found {shown(tests)}; restore the file")
        tests = {name for name in tests if isinstance(name, str)}
        images: list[PosedImage | None] = []
        names: list[str] = []
        warnings: list[str] = []
        for index, frame in enumerate(meta["frames"]):
            name, image = transforms.find_image(folder, transforms.read_file_path(frame, index, path), options.images)
            lens = transforms.read_lens(meta, frame, path, image)
            given = folder / str(frame["mask_path"]) if frame.get("mask_path") else None
            mask = given if given and given.is_file() else image and find_mask(folder, name.partition("/")[2] or name, image)
            angle = transforms.read_angle(meta, frame, path) if lens is None else 0.0
            pose = transforms.read_pose(frame, path)
            names.append(name)
            images.append(image and PosedImage(name, image, lens, pose, mask, angle, frame.get("file_path") in tests))
        kept = transforms.drop_absent(folder, images, names, warnings)
        points = transforms.read_points(folder, meta.get("ply_file_path"))
        return RawCapture(kept, points, warnings, points_source="the file that ply_file_path names")


READER = NerfstudioReader()
