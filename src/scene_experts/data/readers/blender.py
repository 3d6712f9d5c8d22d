"""Reads NeRF-synthetic captures: transforms_train.json and transforms_test.json, as rendered with
Blender."""

from __future__ import annotations

from pathlib import Path

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import CAPTURE
from scene_experts.core.reading.source import guarding
from scene_experts.data.images import has_alpha
from scene_experts.data.readers import transforms
from scene_experts.data.readers.reader import PosedImage, RawCapture, ReadOptions

WHITE = (1.0, 1.0, 1.0)
BOUNDS = ((-1.3, -1.3, -1.3), (1.3, 1.3, 1.3))  # 3DGS fills this cube with random points


class BlenderReader:
    """Reads a NeRF-synthetic capture. Such captures state their split and have transparent
    photographs, but no points."""

    name = "blender"
    files = "transforms_train.json (NeRF-synthetic)"

    def recognise(self, folder: Path) -> bool:
        return (folder / "transforms_train.json").is_file()

    def read(self, folder: Path, options: ReadOptions) -> RawCapture:
        """Read poses, the split and, if there are any, points. Alpha is composited over
        `options.background` (default white, where a photograph has alpha).

        Frames without an image are dropped with a warning. Raises InputError if a file is damaged,
        if no frame is left, and for `options.images`: each file path names its folder.
        """
        if options.images is not None:
            raise InputError(
                f"expected no image folder {options.images} for {folder}, whose transforms_*.json name the photographs; leave "
                f"--images out, and resize with --resolution factor:N"
            )
        with guarding(folder, CAPTURE):
            return self._read(folder, options)

    def _read(self, folder: Path, options: ReadOptions) -> RawCapture:
        images: list[PosedImage | None] = []
        names: list[str] = []
        warnings: list[str] = []
        for part in ("train", "test"):
            path = folder / f"transforms_{part}.json"
            if part == "train" or path.is_file():
                meta = transforms.read_meta(path)
                for index, frame in enumerate(meta["frames"]):
                    name, image = transforms.find_image(folder, transforms.read_file_path(frame, index, path), None)
                    lens = transforms.read_lens(meta, frame, path, image)
                    angle = transforms.read_angle(meta, frame, path) if lens is None else 0.0
                    pose = transforms.read_pose(frame, path)
                    names.append(name)
                    images.append(image and PosedImage(name, image, lens, pose, None, angle, part == "test"))
        kept = transforms.drop_absent(folder, images, names, warnings)
        over = options.background
        if over is None and any(has_alpha(image.path) for image in kept):
            over = WHITE
            warnings.append(
                "transparent pixels are composited over white; choose another colour with --background (Scaffold-GS evaluates on black)"
            )
        points, cloud = transforms.read_points(folder, None, warnings) if options.points else (None, None)
        return RawCapture(
            kept,
            points,
            warnings,
            alpha_over=over,
            points_source="points3d.ply",
            cloud=cloud,
            states_split=True,
            bounds=BOUNDS,
        )


READER = BlenderReader()
