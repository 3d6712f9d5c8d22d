"""Panoramas of a trained scene, what `capture` makes of them, and the same views drawn at once.

    python benchmarks/panoramas.py RUN --out OUT [--places 24] [--width 2048]

Panoramas are drawn at the places of evenly chosen training cameras, upright, their middles where
these cameras look: six square pictures of 90 degrees, resampled to 2:1 (four samples a pixel). OUT
gets `panoramas`, `capture` (of `scene-experts capture`, one thread) and `direct`: the same views
with the same lens, drawn by the scene from the true places and directions, in a capture with the
same points. Prints how many views have a pose, and how far the places and directions are from the
true ones after a similarity transform. `scene-experts train` of both captures then tells what
panoramas cost.
"""

from __future__ import annotations

import argparse
import dataclasses
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch.nn import functional

import scene_experts as se
from scene_experts.data.equirectangular import FIELD, VIEWS, find_place, view_side
from scene_experts.data.readers.colmap_model import find_models, read_model, write_model
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix

FACES = [np.eye(3)[:, order] * signs for order, signs in (
    ([0, 1, 2], (1, 1, 1)), ([2, 1, 0], (-1, 1, 1)), ([0, 1, 2], (-1, 1, -1)), ([2, 1, 0], (1, 1, -1)),
    ([0, 2, 1], (1, 1, -1)), ([0, 2, 1], (1, -1, 1)),
)]  # fmt: skip
"""Rotations [3, 3] from the axes of a face to those of the panorama: ahead, right, behind, left, up, down."""
PARTS = {view.folder: view.rig_from_view for view in VIEWS}


def choose_places(run: se.Run, count: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the centres [3] of panoramas and the rotations [3, 3] from their axes to the world."""
    cameras, up = run.train_cameras, run.capture.up
    chosen = []
    for index in np.linspace(0, len(cameras) - 1, count).round().astype(int):
        ahead = cameras[index].world_to_camera[2, :3]
        ahead = ahead - up * (ahead @ up)
        ahead /= np.linalg.norm(ahead)
        chosen.append((cameras[index].position, np.stack([np.cross(-up, ahead), -up, ahead], 1)))
    return chosen


def draw(run: se.Run, centre: np.ndarray, turn: np.ndarray, side: int) -> np.ndarray:
    """Return the square picture [side, side, 3] of FIELD degrees; turn: camera to world."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn, centre
    focal = side / 2 / np.tan(np.radians(FIELD / 2))
    return run.render(se.Camera.from_pose(pose, width=side, height=side, fx=focal, cx=side / 2, cy=side / 2))


def draw_panorama(run: se.Run, centre: np.ndarray, turn: np.ndarray, width: int, fine: int = 2) -> np.ndarray:
    """Return the panorama [width / 2, width, 3] float32; fine: samples a pixel and axis."""
    lon = ((torch.arange(width * fine) + 0.5) / (width * fine) - 0.5) * 2 * torch.pi
    lat = (0.5 - (torch.arange(width * fine // 2) + 0.5) / (width * fine // 2)) * torch.pi
    lat, lon = torch.meshgrid(lat, lon, indexing="ij")
    rays = torch.stack([lon.sin() * lat.cos(), -lat.sin(), lon.cos() * lat.cos()], -1)
    local = torch.stack([rays @ torch.from_numpy(face).float() for face in FACES])
    owner = local[..., 2].argmax(0)
    out = torch.zeros(*rays.shape)
    for k, face in enumerate(FACES):
        picture = torch.from_numpy(draw(run, centre, turn @ face, int(width * 0.45)))
        grid = (local[k, ..., :2] / local[k, ..., 2:].clamp_min(1e-6))[None]
        drawn = functional.grid_sample(picture.permute(2, 0, 1)[None], grid, "bicubic", "border", align_corners=False)[0]
        out[owner == k] = drawn.permute(1, 2, 0)[owner == k]
    return functional.avg_pool2d(out.permute(2, 0, 1)[None], fine)[0].permute(1, 2, 0).numpy()


def save(picture: np.ndarray, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray((255 * picture.clip(0, 1) + 0.5).astype(np.uint8)).save(path, quality=96, subsampling=0)


def align(found: torch.Tensor, true: torch.Tensor) -> tuple[float, torch.Tensor, torch.Tensor]:
    """Return the similarity true = s R found + t of centres [N, 3] (Umeyama 1991)."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, sizes, vh = torch.linalg.svd(b.T @ a)
    sign = torch.tensor([1.0, 1.0, float(torch.det(u @ vh).sign())], dtype=a.dtype)
    turn, scale = u @ torch.diag(sign) @ vh, float((sizes * sign).sum() / a.square().sum())
    return scale, turn, true.mean(0) - scale * turn @ found.mean(0)


def place_truly(capture: Path, direct: Path, places: dict[str, tuple[np.ndarray, np.ndarray]]) -> list[str]:
    """Write the capture `direct`: the points of `capture` in the frame of the true places, and the
    true poses. Returns the views with a pose."""
    model = read_model(find_models(capture)[0])
    turns = [quat_to_matrix(torch.tensor(image.quaternion, dtype=torch.float64)[None])[0] for image in model.images]
    centres = torch.stack([-R.T @ torch.tensor(image.translation, dtype=torch.float64) for R, image in zip(turns, model.images)])
    keys = [find_place(image.name).removesuffix(".jpg") for image in model.images]
    true = torch.from_numpy(np.stack([places[key][0] for key in keys]))
    scale, turn, shift = align(centres, true)
    off = (scale * centres @ turn.T + shift - true).norm(dim=1)
    images, angles = [], []
    for image, R, key in zip(model.images, turns, keys):
        centre, rig = (torch.from_numpy(value) for value in places[key])
        wanted = (rig @ torch.from_numpy(PARTS[image.name.split("/")[0]])).T
        cosine = ((torch.trace(R @ turn.T @ wanted.T) - 1) / 2).clamp(-1, 1)
        angles.append(float(torch.rad2deg(torch.arccos(cosine))))
        pose = tuple(matrix_to_quat(wanted[None])[0].tolist()), tuple((-wanted @ centre).tolist())
        images.append(dataclasses.replace(image, quaternion=pose[0], translation=pose[1]))
    points = (scale * torch.from_numpy(model.xyz) @ turn.T + shift).numpy()
    write_model(direct / "sparse/0", dataclasses.replace(model, images=tuple(images), xyz=points))
    spread = float(torch.cdist(true, true).max())
    print(f"poses: {len(images)} of {len(VIEWS) * len(places)} views, {len(set(keys))} of {len(places)} places")
    print(f"places off: median {100 * float(off.median()) / spread:.4f}, most {100 * float(off.max()) / spread:.4f} % of the extent")
    print(f"directions off: median {np.median(angles):.4f}, most {max(angles):.4f} degrees")
    return [image.name for image in images]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of a training")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--places", type=int, default=24)
    parser.add_argument("--width", type=int, default=2048, help="of a panorama in pixels")
    asked = parser.parse_args()
    torch.set_num_threads(1)
    run = se.open_run(asked.run)
    places = {f"place{k:02d}": place for k, place in enumerate(choose_places(run, asked.places))}
    for name, (centre, turn) in places.items():
        if not (asked.out / f"panoramas/{name}.jpg").is_file():
            save(draw_panorama(run, centre, turn, asked.width), asked.out / f"panoramas/{name}.jpg")
        print("drawn:", name, flush=True)
    capture, direct = asked.out / "capture", asked.out / "direct"
    words = ["capture", str(asked.out / "panoramas"), "--out", str(capture), "--threads", "1"]
    process = subprocess.Popen([sys.executable, "-m", "scene_experts", *words])
    usage = os.wait4(process.pid, 0)[2]
    print(f"capture: {usage.ru_utime + usage.ru_stime:.0f} CPU s", flush=True)
    shutil.copytree(capture, direct, ignore=shutil.ignore_patterns("images", "sparse", "*.db", "sfm"), dirs_exist_ok=True)
    for name in place_truly(capture, direct, places):
        centre, turn = places[find_place(name).removesuffix(".jpg")]
        save(draw(run, centre, turn @ PARTS[name.split("/")[0]], view_side(asked.width)), direct / "images" / name)


if __name__ == "__main__":
    main()
