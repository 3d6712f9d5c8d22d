"""Writes synthetic captures as other programs export them: RealityCapture, Metashape, Bundler and Polycam.

The conventions are those of the readers. That the readers follow the programs is tested with values from elsewhere.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np

from support.synthetic import Synthetic, make_capture, opengl

BACK = np.diag([1.0, -1.0, -1.0])  # OpenCV axes from OpenGL axes


def _make(folder: Path, views: int, size: tuple[int, int], points: int) -> Synthetic:
    made = make_capture(folder, views, size, points=points, mixed_sizes=False)
    shutil.rmtree(folder / "sparse")
    return made


def _write_points(path: Path, made: Synthetic) -> None:
    head = f"ply\nformat ascii 1.0\nelement vertex {len(made.model.xyz)}\n" + "".join(f"property double {a}\n" for a in "xyz")
    head += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    path.write_text(head + "".join(" ".join(map(repr, (*p, *c))) + "\n" for p, c in zip(made.model.xyz.tolist(), made.model.rgb.tolist())))


def make_realitycapture(folder: Path, views: int = 4, size: tuple[int, int] = (48, 32), points: int = 40) -> Synthetic:
    """Write cameras.csv and cloud.ply. The focal length is the mean of the two."""
    made = _make(folder, views, size, points)
    lines = [f"#cameras {views}", "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"]
    for image in made.model.images:
        lens, pose = made.model.cameras[image.camera_id], np.linalg.inv(image.world_to_cam())
        axes = pose[:3, :3] @ BACK
        heading, pitch = np.arctan2(axes[0, 1], axes[1, 1]), np.arcsin(axes[2, 1])
        angles = np.rad2deg([heading, pitch, np.arctan2(-axes[2, 0], axes[2, 2])])
        side = max(lens.width, lens.height)
        inside = [18 * (lens.fx + lens.fy) / side, (lens.cx - lens.width / 2) / side, (lens.cy - lens.height / 2) / side]
        lines.append(",".join([image.name, *map(repr, [*pose[:3, 3].tolist(), *angles.tolist(), *inside]), *["0"] * 6]))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")
    _write_points(folder / "cloud.ply", made)
    return made


def make_metashape(folder: Path, views: int = 4, size: tuple[int, int] = (48, 32), points: int = 40) -> Synthetic:
    """Write cameras.xml with a chunk of another scale, turned and shifted, and cloud.ply."""
    made = _make(folder, views, size, points)
    turn, shift, scale = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([3.0, -2.0, 1.0]), 2.5
    lens = made.model.cameras[1]
    numbers = {"f": lens.fy, "cx": lens.cx - lens.width / 2, "cy": lens.cy - lens.height / 2, "b1": lens.fx - lens.fy}
    inside = "".join(f"<{name}>{value!r}</{name}>" for name, value in numbers.items())
    cameras = []
    for image in made.model.images:
        pose = np.linalg.inv(image.world_to_cam())
        pose[:3, :3], pose[:3, 3] = turn.T @ pose[:3, :3], turn.T @ (pose[:3, 3] - shift) / scale
        text = " ".join(map(repr, pose.ravel().tolist()))
        cameras.append(f'<camera id="{image.id}" sensor_id="0" component_id="0" label="{Path(image.name).stem}">')
        cameras[-1] += f"<transform>{text}</transform></camera>"
    (folder / "cameras.xml").write_text(
        f'''<?xml version="1.0" encoding="UTF-8"?>
<document version="2.0.0"><chunk label="Chunk 1" enabled="true">
<sensors next_id="1"><sensor id="0" label="camera" type="frame"><resolution width="{lens.width}" height="{lens.height}"/>
<calibration type="frame" class="initial"><f>1</f></calibration>
<calibration type="frame" class="adjusted"><resolution width="{lens.width}" height="{lens.height}"/>{inside}</calibration>
</sensor></sensors>
<components next_id="1" active_id="0"><component id="0" label="Component 1"><transform>
<rotation locked="false">{" ".join(map(repr, turn.ravel().tolist()))}</rotation>
<translation locked="false">{" ".join(map(repr, shift.tolist()))}</translation>
<scale locked="false">{scale}</scale></transform></component></components>
<cameras next_id="9"><group id="0" label="Group 1">{"".join(cameras[:2])}</group>{"".join(cameras[2:])}</cameras>
<reference>LOCAL_CS["Local Coordinates (m)"]</reference></chunk></document>
'''
    )
    _write_points(folder / "cloud.ply", made)
    return made


def make_bundler(folder: Path, views: int = 4, size: tuple[int, int] = (48, 32), points: int = 40) -> Synthetic:
    """Write bundle.out and list.txt. The focal length is that along x, and the principal point the middle."""
    made = _make(folder, views, size, points)
    lines = ["# Bundle file v0.3", f"{views} {points}"]
    for image in made.model.images:
        pose = np.diag([1.0, -1.0, -1.0, 1.0]) @ image.world_to_cam()
        lines.append(f"{made.model.cameras[image.camera_id].fx!r} 0.01 -0.002")
        lines += [" ".join(map(repr, row)) for row in [*pose[:3, :3].tolist(), pose[:3, 3].tolist()]]
    for xyz, rgb in zip(made.model.xyz.tolist(), made.model.rgb.tolist()):
        lines += [" ".join(map(repr, xyz)), " ".join(map(str, rgb)), "2 0 5 1.5 -2.5 1 7 0.5 0.25"]
    (folder / "bundle.out").write_text("\n".join(lines) + "\n")
    (folder / "list.txt").write_text("".join(f"images/{image.name} 0 50.5\n" for image in made.model.images))
    return made


def make_polycam(folder: Path, views: int = 4, size: tuple[int, int] = (48, 32), points: int = 40, kind: str = "corrected_") -> Synthetic:
    """Write keyframes with one JSON file a photograph, and cloud.ply beside them."""
    made = _make(folder, views, size, points)
    cameras = folder / "keyframes" / f"{kind}cameras"
    cameras.mkdir(parents=True, exist_ok=True)
    shutil.move(folder / "images", folder / "keyframes" / f"{kind}images")
    for image in made.model.images:
        lens = made.model.cameras[image.camera_id]
        value = {
            f"t_{row}{column}": number for row, line in enumerate(opengl(image.world_to_cam())[:3]) for column, number in enumerate(line)
        }
        value |= {
            "fx": lens.fx,
            "fy": lens.fy,
            "cx": lens.cx,
            "cy": lens.cy,
            "width": lens.width,
            "height": lens.height,
            "blur_score": 100.0,
        }
        (cameras / f"{Path(image.name).stem}.json").write_text(json.dumps(value))
    _write_points(folder / "cloud.ply", made)
    return made
