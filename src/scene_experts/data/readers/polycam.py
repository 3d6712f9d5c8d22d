"""Reads Polycam's raw data: a folder keyframes with one JSON file for each photograph.

t_00 to t_23 map the camera, with axes x right, y up, z back, to the world, whose y axis is up.
corrected_cameras and corrected_images are those that Polycam has optimised, cameras and images
those of the phone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.numbers import to_size
from scene_experts.core.reading.source import describe, guarding
from scene_experts.data.depth_maps import DepthFile
from scene_experts.data.lens import Lens
from scene_experts.data.readers import poses, transforms
from scene_experts.data.readers.reader import RawCapture, ReadOptions

_KINDS = ("corrected_", "")
MILLIMETRE = 0.001  # in metres, the unit of the poses


class PolycamReader:
    """Reads the keyframes of a raw export, the corrected ones if there are any."""

    name = "polycam"
    files = "keyframes/cameras beside keyframes/images (Polycam)"

    def recognise(self, folder: Path) -> bool:
        return _find(folder) is not None

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses and lenses. Raises InputError if a file is damaged, for `options.images`, or
        if photographs are absent (with `options.missing == "drop"`: if all are)."""
        if options.images is not None:
            raise InputError(
                f"expected no image folder {options.images} for {folder}, whose photographs lie in keyframes; leave --images out"
            )
        with guarding(folder, CAPTURE):
            found = _find(folder)
            assert found is not None
            place, kind = found
            files = sorted((place / f"{kind}cameras").glob("*.json"))
            warnings = [] if kind else ["the poses are those of the phone: Polycam has not written corrected ones"]
            posed = [_read_pose(path) for path in files]
            depths = {pose.name: found for pose in posed if (found := _find_depth(place, pose.name)) is not None}
            return poses.assemble(folder, files[0].parent, posed, options, warnings, images=place / f"{kind}images", depths=depths)


def _find(folder: Path) -> tuple[Path, str] | None:
    """Return the folder of the keyframes and the first word of its folders' names."""
    for place in (folder / "keyframes", folder):
        for kind in _KINDS:
            if (place / f"{kind}images").is_dir() and next((place / f"{kind}cameras").glob("*.json"), None) is not None:
                return place, kind
    return None


def _find_depth(place: Path, name: str) -> DepthFile | None:
    """Return the depth map of a keyframe, in millimetres, if the phone has a LiDAR."""
    depth, confidence = (place / kind / f"{name}.png" for kind in ("depth", "confidence"))
    return DepthFile(depth, MILLIMETRE, confidence if confidence.is_file() else None) if depth.is_file() else None


def _read_pose(path: Path) -> poses.Pose:
    value: Any = read_json(path, "camera")
    try:
        matrix = [[float(value[f"t_{row}{column}"]) for column in range(4)] for row in range(3)]
        size = to_size(value["width"]), to_size(value["height"])
        fx, fy, cx, cy = (float(value[name]) for name in ("fx", "fy", "cx", "cy"))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"expected t_00 to t_23, fx, fy, cx, cy, width and height as numbers in {path}, found {describe(error)}; export them again"
        ) from None
    pose = transforms.read_pose({"transform_matrix": matrix, "file_path": path.stem}, path)
    return poses.Pose(path.stem, pose, lambda _: Lens("PINHOLE", *size, (fx, fy, cx, cy)))


READER = PolycamReader()
