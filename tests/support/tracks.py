"""Tracks for made captures, whose reconstruction has none."""

from pathlib import Path

import numpy as np
import torch

from scene_experts.data.readers.colmap_model import read_model
from scene_experts.geometry.bundle import move
from scene_experts.geometry.rotation import matrix_to_quat


def add_tracks(folder: Path, turned: float = 0.0, shifted: float = 0.0, unseen: tuple[str, ...] = ()) -> None:
    """Write where the photographs of a COLMAP capture show its points, all that are inside; then
    turn the cameras by `turned` rad about random axes and shift them by `shifted`, and the points
    half as far. The photographs `unseen` show none."""
    place = folder / "sparse/0"
    model, rng = read_model(place), np.random.default_rng(0)
    lines = []
    for image in sorted(model.images, key=lambda i: i.name):
        lens, pose = model.cameras[image.camera_id], image.world_to_cam()
        x, y, z = (model.xyz @ pose[:3, :3].T + pose[:3, 3]).T
        u, v = lens.distort(x / z, y / z)
        xy = np.stack([u * lens.fx + lens.cx, v * lens.fy + lens.cy], 1)
        inside = (z > 0) & (xy > 0).all(1) & (xy < (lens.width, lens.height)).all(1) & (image.name not in unseen)
        axis, way = (direction / np.linalg.norm(direction) for direction in rng.normal(size=(2, 3)))
        pose = move(pose[None], np.concatenate([axis * turned, way * shifted])[None])[0]
        q = matrix_to_quat(torch.from_numpy(pose[:3, :3])).tolist()
        lines.append(" ".join(map(repr, [image.id, *q, *pose[:3, 3].tolist(), image.camera_id])) + f" {image.name}")
        lines.append(" ".join(f"{a!r} {b!r} {id}" for (a, b), id in zip(xy[inside].tolist(), model.ids[inside])))
    points = model.xyz + rng.normal(size=model.xyz.shape) * shifted / 2
    rows = (f"{id} {' '.join(map(repr, xyz.tolist()))} {' '.join(map(str, rgb))} 0" for id, xyz, rgb in zip(model.ids, points, model.rgb))
    for name, text in (("images", lines), ("points3D", rows)):
        (place / f"{name}.bin").unlink(missing_ok=True)
        (place / f"{name}.txt").write_text("\n".join(text) + "\n")
