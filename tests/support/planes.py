"""Views of textured planes whose depth is known, for the plane sweep."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from scene_experts.data.dense.pairs import Pairs
from scene_experts.data.dense.pictures import SmallPictures
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import ColmapImage, Model, write_model
from support.synthetic import quaternion

Array = NDArray[np.float64]
Shape = Callable[[Array, Array], tuple[Array, NDArray[np.bool_]]]  # origin [3], rays [..., 3] -> distance along z, has texture

_WAVES = np.random.default_rng(7).normal(size=(24, 2)) * 8.0, np.random.default_rng(8).uniform(0, 2 * np.pi, 24)


def texture(x: Array, y: Array) -> Array:
    """Grey levels between 0 and 255 of a plane, with waves of about 0.3 to 2 units."""
    (kx, ky), phase = _WAVES[0].T, _WAVES[1]
    waves = np.sin(x[..., None] * kx + y[..., None] * ky + phase)
    return np.clip(128 + 22 * waves.sum(-1), 0, 255)


def plane(depth: float) -> Shape:
    """A plane z = depth."""
    return lambda origin, rays: ((depth - origin[2]) / rays[..., 2], np.ones(rays.shape[:-1], dtype=bool))


def step(near: float, far: float) -> Shape:
    """A plane z = near where x < 0, before a plane z = far."""

    def shape(origin: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        t = (near - origin[2]) / rays[..., 2]
        hit = origin[0] + t * rays[..., 0] < 0
        return np.where(hit, t, (far - origin[2]) / rays[..., 2]), np.ones(rays.shape[:-1], dtype=bool)

    return shape


def hole(depth: float, half: float, far: float) -> Shape:
    """A plane z = depth with a square hole around the axis, through which a grey plane z = far shows."""

    def shape(origin: Array, rays: Array) -> tuple[Array, NDArray[np.bool_]]:
        t = (depth - origin[2]) / rays[..., 2]
        at = origin[:2] + t[..., None] * rays[..., :2]
        inside = (np.abs(at) < half).all(-1)
        return np.where(inside, (far - origin[2]) / rays[..., 2], t), ~inside

    return shape


def pose(x: float, turn: float = 0.0, y: float = 0.0) -> Array:
    """World to camera [4, 4] of a camera at (x, y, 0) that looks along z, turned by `turn` radians around y."""
    out = np.eye(4)
    c, s = np.cos(turn), np.sin(turn)
    out[:3, :3] = ((c, 0, -s), (0, 1, 0), (s, 0, c))
    out[:3, 3] = -out[:3, :3] @ (x, y, 0.0)
    return out


def poses(count: int = 5, apart: float = 0.5) -> list[Array]:
    """Cameras in a row, turned towards its middle a little, and not quite at one height."""
    xs = apart * (np.arange(count) - (count - 1) / 2)
    return [pose(x, -0.1 * x, 0.1 * (-1) ** i) for i, x in enumerate(xs)]


def look(shape: Shape, world_to_cam: Array, size: tuple[int, int], focal: float) -> tuple[Array, Array]:
    """Return the picture [H, W] and the depths [H, W] of a camera, with 3 x 3 samples a pixel."""
    width, height = size
    grid = lambda n, samples: (np.arange(n * samples) + 0.5) / samples  # noqa: E731
    out = []
    for samples in (3, 1):
        u, v = np.meshgrid((grid(width, samples) - width / 2) / focal, (grid(height, samples) - height / 2) / focal)
        rays = np.stack((u, v, np.ones_like(u)), -1) @ world_to_cam[:3, :3]
        origin = -world_to_cam[:3, :3].T @ world_to_cam[:3, 3]
        t, textured = shape(origin, rays)
        at = origin + t[..., None] * rays
        grey = np.where(textured, texture(at[..., 0], at[..., 1]), 90.0)
        out.append((grey.reshape(height, samples, width, samples).mean((1, 3)), t))
    return out[0][0], out[1][1]


def reduced(shape: Shape, cameras: list[Array], size: tuple[int, int] = (48, 36), focal: float = 48.0) -> tuple[SmallPictures, list[Array]]:
    """Return the views of a shape as the sweep takes them, and their depths [H, W]."""
    seen = [look(shape, camera, size, focal) for camera in cameras]
    grey = torch.from_numpy(np.concatenate([picture.ravel() for picture, _ in seen])).float()
    numbers = [[*camera[:3].ravel(), focal, focal, size[0] / 2, size[1] / 2] for camera in cameras]
    start = torch.arange(len(cameras) + 1) * size[0] * size[1]
    sizes = torch.tensor([size] * len(cameras), dtype=torch.int32)
    rgb = grey.round().byte()[:, None].repeat(1, 3)
    return SmallPictures(grey, rgb, start, sizes, torch.tensor(numbers, dtype=torch.float64)), [depth for _, depth in seen]


def neighbours(count: int, near: float, far: float, k: int = 3) -> Pairs:
    """Compare each of `count` views in a row with its nearest ones, between two depths."""
    order = [sorted((other for other in range(count) if other != view), key=lambda o: (abs(o - view), o))[:k] for view in range(count)]
    compared = [row + [-1] * (k - len(row)) for row in order]
    return Pairs(torch.tensor(compared, dtype=torch.int32), torch.tensor([[1 / far, 1 / near]] * count, dtype=torch.float64))


def make_planes(
    folder: Path, shape: Shape, views: int = 9, size: tuple[int, int] = (64, 48), points: int = 300, apart: float = 0.5
) -> Path:
    """Write a COLMAP capture of a shape, with points on its surfaces."""
    rng, cameras = np.random.default_rng(0), poses(views, apart)
    (folder / "images").mkdir(parents=True)
    images = []
    for i, camera in enumerate(cameras):
        grey = np.rint(look(shape, camera, size, float(size[0]))[0]).astype(np.uint8)
        Image.fromarray(np.stack((grey, grey, 255 - grey), -1)).save(folder / "images" / f"view_{i:03d}.png")
        x, y, z = camera[:3, 3].tolist()
        images.append(ColmapImage(i + 1, f"view_{i:03d}.png", quaternion(camera[:3, :3]), (x, y, z), 1))
    uv = (rng.random((points, 2)) - 0.5) * (1.0, size[1] / size[0])
    rays = np.concatenate((uv, np.ones((points, 1))), 1)
    xyz = shape(np.zeros(3), rays)[0][:, None] * rays
    lens = Lens("PINHOLE", *size, (float(size[0]), float(size[0]), size[0] / 2, size[1] / 2))
    rgb = np.full((points, 3), 128, dtype=np.uint8)
    write_model(folder / "sparse" / "0", Model({1: lens}, tuple(images), np.arange(1, points + 1), xyz, rgb, np.full(points, 0.5)))
    return folder
