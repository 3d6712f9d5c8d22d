"""Captures of nerfstudio with depth maps of planes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from PIL import Image

from support.planes import look, poses, step

FOCAL = 60.0


def make_depths(folder: Path, views: int = 5, size: tuple[int, int] = (64, 48), times: float = 1.0, cloud: bool = False) -> Path:
    """Write views of two planes with their depth, in thousandths and multiplied by `times`.

    cloud: Write the points that the first view sees, too; otherwise the depth maps give the points.
    """
    frames = []
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for index, pose in enumerate(poses(views)):
        grey, depth = look(step(3.0, 4.0), pose, size, FOCAL)
        Image.fromarray(np.repeat(grey[..., None], 3, 2).astype(np.uint8)).save(folder / f"images/{index}.png")
        Image.fromarray((1000 * times * depth).round().astype(np.uint16)).save(folder / f"depth/{index}.png")
        back = np.linalg.inv(pose) @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"images/{index}.png", "depth_file_path": f"depth/{index}.png", "transform_matrix": back.tolist()})
    lens = {"w": size[0], "h": size[1], "fl_x": FOCAL, "fl_y": FOCAL, "cx": size[0] / 2, "cy": size[1] / 2}
    named = {"ply_file_path": "cloud.ply"} if cloud else {}
    (folder / "transforms.json").write_text(json.dumps({**lens, **named, "frames": frames}))
    if cloud:
        _write_cloud(folder / "cloud.ply", size)
    return folder


def _write_cloud(path: Path, size: tuple[int, int]) -> None:
    pose = poses(5)[0]
    _, depth = look(step(3.0, 4.0), pose, size, FOCAL)
    u, v = np.meshgrid((np.arange(size[0]) + 0.5 - size[0] / 2) / FOCAL, (np.arange(size[1]) + 0.5 - size[1] / 2) / FOCAL)
    places = (np.stack((u, v, np.ones_like(u)), -1) * depth[..., None] - pose[:3, 3]).reshape(-1, 3) @ pose[:3, :3]
    head = "".join(f"property float {axis}\n" for axis in "xyz") + "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    rows = "".join(f"{x:.6f} {y:.6f} {z:.6f} 90 90 90\n" for x, y, z in places)
    path.write_text(f"ply\nformat ascii 1.0\nelement vertex {len(places)}\n{head}end_header\n{rows}")
