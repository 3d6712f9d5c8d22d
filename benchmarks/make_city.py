"""Make a capture of a city: textured boxes on a ground with streets, drawn from many exact cameras. For trainings in blocks.

Usage: python benchmarks/make_city.py --out CITY [--buildings 12] [--views 400] [--width 640] [--points 200000]
The city has buildings x buildings boxes, one unit apart. The cameras fly in rows above it and look down obliquely, into changing
directions. Every pixel is the mean of 2 x 2 rays. CITY is a COLMAP capture (images/ and sparse/0/) with points on the surfaces.
The number of anchors follows from the points and --scene.voxel-size, for example: 2 million points and a voxel of a hundredth of a unit.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import ColmapImage, Model, write_model
from scene_experts.geometry.poses import look_at
from scene_experts.geometry.rotation import matrix_to_quat

Array = NDArray[np.float64]
SKY = (0.62, 0.74, 0.86)


def make_boxes(side: int, rng: np.random.Generator) -> Array:
    """Return the lower and upper corners [side * side, 2, 3] of the buildings."""
    centre = np.stack(np.meshgrid(np.arange(side), np.arange(side), indexing="ij"), -1).reshape(-1, 2) - (side - 1) / 2
    half, height = rng.uniform(0.2, 0.36, centre.shape), rng.uniform(0.2, 1.4, (len(centre), 1))
    return np.stack((np.hstack((centre - half, 0 * height)), np.hstack((centre + half, height))), 1)


EDGES = [(i, i | bit) for i in range(8) for bit in (1, 2, 4) if not i & bit]  # of a box: pairs of corners that differ in one coordinate


def paint(xyz: Array, box: NDArray[np.int64]) -> Array:
    """Return the colour [..., 3] of surface points. box: number of the building, -1 for the ground."""
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    grain = 0.5 + 0.25 * np.sin(37 * x + 3 * np.sin(11 * y)) * np.sin(41 * y + 2 * z) + 0.25 * np.sin(23 * (x + y + 2 * z))
    street = np.minimum(abs(x % 1 - 0.5), abs(y % 1 - 0.5)) < 0.1
    ground = np.where(street[..., None], 0.3, np.stack((0.25 + 0.2 * grain, 0.4 + 0.2 * grain, 0.22 + 0.1 * grain), -1))
    hue = np.stack([0.55 + 0.35 * np.sin(2.4 * box + phase) for phase in (0.0, 2.1, 4.2)], -1)
    windows = (np.sin(60 * (x + y)) > 0.2) & (np.sin(45 * z) > 0) & (z > 0.05)
    wall = hue * np.where(windows, 0.45, 0.7 + 0.3 * grain)[..., None]
    return np.clip(np.where((box < 0)[..., None], ground, wall), 0, 1)


def before(corners: Array, near: float) -> Array:
    """Return the corners [8, 3] of a box in the camera's frame that lie beyond the plane z = near, and where its edges meet the plane."""
    seen = [corners[corners[:, 2] >= near]]
    for i, j in EDGES:
        a, b = corners[i], corners[j]
        if (a[2] < near) != (b[2] < near):
            seen.append((a + (near - a[2]) / (b[2] - a[2]) * (b - a))[None])
    return np.concatenate(seen)


def trace(origin: Array, rays: Array, pose: Array, lens: Lens, boxes: Array, half: float, samples: int) -> tuple[Array, NDArray[np.int64]]:
    """Return the distance along each ray [H, W, 3] (inf for the sky) and the number of the building it meets (-1: the ground)."""
    with np.errstate(divide="ignore", invalid="ignore"):
        best = -origin[2] / rays[..., 2]
        at = origin[:2] + best[..., None] * rays[..., :2]
        best = np.where((best > 0) & (np.abs(at) <= half).all(-1), best, np.inf)
        number = np.full(best.shape, -1)
        for i, (low, high) in enumerate(boxes):
            corners = np.stack(np.meshgrid(*zip(low, high), indexing="ij"), -1).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
            seen = before(corners, 0.05)
            if not len(seen):
                continue
            u, v = (seen[:, :2] / seen[:, 2:] * lens.fx + (lens.cx, lens.cy)).T * samples  # only the rays through the picture of the box
            columns, rows = (slice(max(0, int(a.min()) - 1), max(0, int(a.max()) + 2)) for a in (u, v))
            if rows.start >= rays.shape[0] or columns.start >= rays.shape[1] or rows.stop < 2 or columns.stop < 2:
                continue
            part = rays[rows, columns]
            ends = np.stack(((low - origin) / part, (high - origin) / part))
            enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
            nearer = (enter < leave) & (enter > 0) & (enter < best[rows, columns])
            best[rows, columns] = np.where(nearer, enter, best[rows, columns])
            number[rows, columns] = np.where(nearer, i, number[rows, columns])
    return best, number


def draw(pose: Array, lens: Lens, boxes: Array, half: float, samples: int = 2) -> NDArray[np.uint8]:
    """Return the picture [H, W, 3] of the city from a world-to-camera matrix [4, 4]."""
    u, v = np.meshgrid((np.arange(lens.width * samples) + 0.5) / samples, (np.arange(lens.height * samples) + 0.5) / samples)
    rays = np.stack(((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy, np.ones_like(u)), -1) @ pose[:3, :3]
    origin = -pose[:3, :3].T @ pose[:3, 3]
    depth, number = trace(origin, rays, pose, lens, boxes, half, samples)
    hit = np.isfinite(depth)
    colour = paint(origin + np.where(hit, depth, 0)[..., None] * rays, number)
    colour = np.where(hit[..., None], colour, np.array(SKY))
    return np.rint(colour.reshape(lens.height, samples, lens.width, samples, 3).mean((1, 3)) * 255).astype(np.uint8)


def fly(count: int, half: float, rng: np.random.Generator) -> list[Array]:
    """Return world-to-camera matrices [4, 4] of `count` cameras in rows above the city."""
    side = int(np.ceil(np.sqrt(count)))
    poses = []
    for i in range(count):
        row, place = divmod(i, side)
        place = place if row % 2 == 0 else side - 1 - place
        eye = np.array([(place + 0.5) / side * 2 - 1, (row + 0.5) / side * 2 - 1, 0]) * half + [0, 0, 2.2 + 0.6 * rng.random()]
        way = 2.4 * i + 0.3 * rng.random()
        target = eye * (0.9, 0.9, 0) + 1.6 * np.array([np.cos(way), np.sin(way), 0])
        poses.append(look_at(*(torch.tensor(v, dtype=torch.float64) for v in (eye, target, (0.0, 0.0, 1.0)))).numpy())
    return poses


def scatter(count: int, boxes: Array, half: float, rng: np.random.Generator) -> tuple[Array, NDArray[np.int64]]:
    """Return points [count, 3] on the ground between the buildings, on the walls and on the roofs, and their buildings (-1: ground)."""
    number = rng.integers(0, len(boxes), count)
    low, high = boxes[number, 0], boxes[number, 1]
    xyz = low + rng.random((count, 3)) * (high - low)
    axis = rng.integers(0, 3, count)
    far = (rng.random(count) < 0.5) | (axis == 2)  # a roof, and no floor
    rows = np.arange(count)
    xyz[rows, axis] = np.where(far, high[rows, axis], low[rows, axis])
    ground = rng.random(count) < 0.4
    xyz[ground] = np.hstack((rng.uniform(-half, half, (int(ground.sum()), 2)), np.zeros((int(ground.sum()), 1))))
    cell = np.clip(np.floor(xyz[:, :2] + half).astype(int), 0, round(np.sqrt(len(boxes))) - 1)
    below = cell[:, 0] * round(np.sqrt(len(boxes))) + cell[:, 1]
    covered = ground & ((xyz[:, :2] > boxes[below, 0, :2]) & (xyz[:, :2] < boxes[below, 1, :2])).all(1)
    return xyz[~covered], np.where(ground, -1, number)[~covered]


def make_city(out: Path, buildings: int, views: int, width: int, points: int, seed: int = 0) -> int:
    """Write the capture; returns its number of points."""
    rng = np.random.default_rng(seed)
    boxes, half = make_boxes(buildings, rng), buildings / 2
    height = width * 3 // 4
    lens = Lens("PINHOLE", width, height, (0.9 * width, 0.9 * width, width / 2, height / 2))
    (out / "images").mkdir(parents=True, exist_ok=True)
    images = []
    for i, pose in enumerate(fly(views, half, rng)):
        name = f"view_{i:04d}.png"
        Image.fromarray(draw(pose, lens, boxes, half)).save(out / "images" / name)
        w, x, y, z = matrix_to_quat(torch.from_numpy(pose[None, :3, :3]))[0].tolist()
        images.append(ColmapImage(i + 1, name, (w, x, y, z), tuple(pose[:3, 3].tolist()), 1))
    xyz, number = scatter(points, boxes, half, rng)
    rgb = np.rint(paint(xyz, number) * 255).astype(np.uint8)
    model = Model({1: lens}, tuple(images), np.arange(1, len(xyz) + 1), xyz, rgb, np.zeros(len(xyz)))
    write_model(out / "sparse" / "0", model)
    return len(xyz)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    for name, default in (("buildings", 12), ("views", 400), ("width", 640), ("points", 200_000), ("seed", 0)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    count = make_city(args.out, args.buildings, args.views, args.width, args.points, args.seed)
    print(f"wrote {args.out}: {args.buildings**2} buildings, {args.views} views, {count:,} points")


if __name__ == "__main__":
    main()
