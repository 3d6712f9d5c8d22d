"""Panoramas of a trained scene, what `capture` makes of them, and the same views drawn at once.

    python benchmarks/panoramas.py RUN --out OUT [--places 24] [--width 2048]

Panoramas are drawn at the places of evenly chosen training cameras, upright, their middles where
these cameras look. They are sampled from 56 pictures of 44 degrees each: six faces of a cube do not
meet, because the near plane and the shape of a splat depend on the axis. OUT gets `panoramas`,
`capture` (of `scene-experts capture`, one thread) and `direct`: the same views with the same lens,
sampled from the same pictures, with their true poses, in a capture with the same points. Prints how
many views have a pose, and how far the places and directions are from the true ones after a
similarity transform. `scene-experts train` of both captures then tells what
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
from scene_experts.data.equirectangular import FIELD, VIEWS, PanoramaView, find_place, view_side
from scene_experts.data.readers.colmap_model import find_models, read_model, write_model
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix

TILE = 44  # degrees
ROWS = ((75, 6), (45, 10), (15, 12), (-15, 12), (-45, 10), (-75, 6))
TILES = [PanoramaView(round(360 * k / count), pitch) for pitch, count in ROWS for k in range(count)]
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


def find_rays(turn: np.ndarray, side: int) -> torch.Tensor:
    """Return the rays [side, side, 3] of a view of FIELD degrees; turn: from its axes."""
    across = ((torch.arange(side) + 0.5) / (side / 2) - 1) * float(np.tan(np.radians(FIELD / 2)))
    y, x = torch.meshgrid(across, across, indexing="ij")
    return torch.stack([x, y, torch.ones_like(x)], -1) @ torch.from_numpy(turn).float().T


def find_panorama_rays(width: int) -> torch.Tensor:
    """Return the rays [width / 2, width, 3] of a panorama."""
    lon = ((torch.arange(width) + 0.5) / width - 0.5) * 2 * torch.pi
    lat = (0.5 - (torch.arange(width // 2) + 0.5) / (width // 2)) * torch.pi
    lat, lon = torch.meshgrid(lat, lon, indexing="ij")
    return torch.stack([lon.sin() * lat.cos(), -lat.sin(), lon.cos() * lat.cos()], -1)


class TiledPicture:
    """A picture that is sampled from narrow ones around one place."""

    def __init__(self, rays: torch.Tensor) -> None:
        self.shape, flat = rays.shape, rays.reshape(-1, 3)
        owner = torch.stack([flat @ torch.from_numpy(tile.rig_from_view[:, 2]).float() for tile in TILES]).argmax(0)
        self.places = [(owner == k).nonzero()[:, 0] for k in range(len(TILES))]
        local = [flat[at] @ torch.from_numpy(tile.rig_from_view).float() for at, tile in zip(self.places, TILES)]
        self.grids = [(rays[:, :2] / rays[:, 2:] / float(np.tan(np.radians(TILE / 2))))[None, None] for rays in local]

    def sample(self, tiles: list[torch.Tensor]) -> np.ndarray:
        out = torch.zeros(self.shape).reshape(-1, 3)
        for tile, at, grid in zip(tiles, self.places, self.grids):
            if len(at):
                out[at] = functional.grid_sample(tile[None], grid, "bicubic", "border", align_corners=False)[0, :, 0].T
        return out.reshape(self.shape).numpy()


def draw_tiles(run: se.Run, centre: np.ndarray, turn: np.ndarray, width: int) -> list[torch.Tensor]:
    """Return pictures [3, side, side] all around a place, a little finer than a panorama of `width` pixels."""
    found, side = [], round(0.36 * width * np.tan(np.radians(TILE / 2)))
    focal = side / 2 / np.tan(np.radians(TILE / 2))
    for tile in TILES:
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = turn @ tile.rig_from_view, centre
        camera = se.Camera.from_pose(pose, width=side, height=side, fx=focal, cx=side / 2, cy=side / 2)
        found.append(torch.from_numpy(run.render(camera)).permute(2, 0, 1))
    return found


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


def place_truly(capture: Path, direct: Path, places: dict[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Write the capture `direct`: the points of `capture` in the frame of the true places, and the
    true poses."""
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
    whole = TiledPicture(find_panorama_rays(asked.width))
    views = {folder: TiledPicture(find_rays(turn, view_side(asked.width))) for folder, turn in PARTS.items()}
    for name, (centre, turn) in places.items():
        tiles = draw_tiles(run, centre, turn, asked.width)
        save(whole.sample(tiles), asked.out / f"panoramas/{name}.jpg")
        for folder, view in views.items():
            save(view.sample(tiles), asked.out / f"direct/images/{folder}/{name}.jpg")
        print("drawn:", name, flush=True)
    capture, direct = asked.out / "capture", asked.out / "direct"
    words = ["capture", str(asked.out / "panoramas"), "--out", str(capture), "--threads", "1"]
    process = subprocess.Popen([sys.executable, "-m", "scene_experts", *words])
    usage = os.wait4(process.pid, 0)[2]
    print(f"capture: {usage.ru_utime + usage.ru_stime:.0f} CPU s", flush=True)
    place_truly(capture, direct, places)
    shutil.copyfile(find_models(capture)[0] / "test.txt", direct / "sparse/0/test.txt")


if __name__ == "__main__":
    main()
