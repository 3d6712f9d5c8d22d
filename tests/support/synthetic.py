"""Writes synthetic captures: photo-consistent views of a known scene.

The scene (z up, about 4 units wide) is a square floor with a smooth texture, a red, a green and a blue ball, and a yellow box. It is
ray-cast exactly with 4x4 samples per pixel, and colour depends only on the position. Principal points are off centre, views differ in
size and shape, the colours are distinct and no axis is symmetric. A swapped channel, a centred principal point or a wrong size therefore
changes the pictures.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import ColmapImage, Model, write_model

Array = NDArray[np.floating]

# centre, radius, colour
_BALLS = (
    ((-0.8, 0.4, 0.45), 0.45, (0.85, 0.12, 0.1)),
    ((0.7, 0.8, 0.35), 0.35, (0.1, 0.75, 0.15)),
    ((0.5, -0.8, 0.5), 0.5, (0.1, 0.2, 0.85)),
)
_BOX = ((-0.9, -1.1, 0.0), (-0.3, -0.5, 0.7), (0.9, 0.75, 0.1))
_HALF = 2.0  # half the floor's side


@dataclass(frozen=True)
class Synthetic:
    """A capture that was written, and the scene that it shows."""

    folder: Path
    model: Model  # cameras, poses and points as written
    images: dict[str, NDArray[np.uint8]]  # by name, [H, W, 3]
    scale: float
    background: tuple[float, float, float]

    def picture(self, lens: Lens, world_to_cam: Array, samples: int = 4) -> Array:
        """Return the true picture [H, W, 3] in [0, 1] of a camera in the capture's own units."""
        return picture(lens, world_to_cam, self.scale, self.background, samples)


def colours(xyz: Array) -> Array:
    """Return the colour [..., 3] in (0, 1) of the surface nearest to scene points [..., 3] (unscaled)."""
    surfaces = [np.abs(xyz[..., 2])]
    x, y = xyz[..., 0], xyz[..., 1]
    floor = np.stack((0.5 + 0.4 * np.sin(2.1 * x + 0.5), 0.45 + 0.35 * np.sin(1.7 * y - 0.8), 0.35 + 0.25 * np.sin(1.3 * (x + y))), -1)
    paints = [floor]
    for centre, radius, paint in _BALLS:
        away = xyz - np.array(centre)
        surfaces.append(np.abs(np.linalg.norm(away, axis=-1) - radius))
        shade = 0.8 + 0.2 * np.sin(3 * away[..., :1] / radius + 2 * away[..., 2:] / radius)
        paints.append(np.array(paint) * shade)
    low, high, paint = (np.array(p) for p in _BOX)
    inside = np.minimum(xyz - low, high - xyz)
    outside = np.linalg.norm(np.maximum(-inside, 0), axis=-1)
    surfaces.append(np.where((inside >= 0).all(-1), inside.min(-1), outside))
    paints.append(paint * (0.75 + 0.25 * np.sin(5 * xyz[..., 2:] + 3 * xyz[..., :1])))
    nearest = np.argmin(np.stack(surfaces), 0)
    return np.take_along_axis(np.stack(paints), nearest[None, ..., None], 0)[0]


def hits(origin: Array, rays: Array) -> Array:
    """Return the distance along `rays` [..., 3] from `origin` [3] to the scene, or inf if a ray misses it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = -origin[2] / rays[..., 2]
        at = origin[:2] + t[..., None] * rays[..., :2]
        best = np.where((t > 0) & (np.abs(at) <= _HALF).all(-1), t, np.inf)
        for centre, radius, _ in _BALLS:
            to = origin - np.array(centre)
            a, b, c = (rays**2).sum(-1), (rays * to).sum(-1), (to**2).sum() - radius**2
            root = b * b - a * c
            t = (-b - np.sqrt(root)) / a
            best = np.where((root > 0) & (t > 0) & (t < best), t, best)
        low, high = np.array(_BOX[0]), np.array(_BOX[1])
        ends = np.stack(((low - origin) / rays, (high - origin) / rays))
        enter, leave = ends.min(0).max(-1), ends.max(0).min(-1)
        return np.where((enter < leave) & (enter > 0) & (enter < best), enter, best)


def picture(lens: Lens, world_to_cam: Array, scale: float, background: tuple[float, float, float], samples: int = 4) -> Array:
    """Ray-cast the scene through `lens`, which may be distorted, to a picture [H, W, 3] in [0, 1]."""
    offsets = (np.arange(samples) + 0.5) / samples
    x = (np.arange(lens.width)[:, None] + offsets).ravel()
    y = (np.arange(lens.height)[:, None] + offsets).ravel()
    u, v = np.meshgrid((x - lens.cx) / lens.fx, (y - lens.cy) / lens.fy)
    if lens.distorted:
        u, v = lens.undistort(u, v)
    R, t = world_to_cam[:3, :3], world_to_cam[:3, 3]
    origin = -(R.T @ t) / scale
    rays = np.stack((u, v, np.ones_like(u)), -1) @ R  # rows of R are the camera's axes in the world
    depth = hits(origin, rays)
    hit = np.isfinite(depth)
    seen = colours(origin + np.where(hit, depth, 1.0)[..., None] * rays)
    out = np.where(hit[..., None], seen, np.array(background))
    return out.reshape(lens.height, samples, lens.width, samples, 3).mean((1, 3))


def look_at(eye: Array, target: Array, roll: float = 0.0) -> Array:
    """Return a world-to-camera matrix [4, 4] with OpenCV axes, z of the world up, rolled by `roll` radians."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    out = np.eye(4)
    out[:3, :3] = np.stack((c * right + s * down, c * down - s * right, forward))
    out[:3, 3] = -out[:3, :3] @ eye
    return out


def quaternion(R: Array) -> tuple[float, float, float, float]:
    """Return (w, x, y, z) of a rotation matrix, the leading eigenvector of Bar-Itzhack's symmetric matrix."""
    (a, b, c), (d, e, f), (g, h, i) = R
    K = np.array([[a - e - i, 0, 0, 0], [b + d, e - a - i, 0, 0], [c + g, f + h, i - a - e, 0], [h - f, c - g, d - b, a + e + i]]) / 3
    x, y, z, w = np.linalg.eigh(K)[1][:, -1]
    return (float(w), float(x), float(y), float(z)) if w >= 0 else (-float(w), -float(x), -float(y), -float(z))


def lenses(size: tuple[int, int], mixed_sizes: bool, principal_point_offset: bool, distortion: Lens | None) -> list[Lens]:
    """Return one lens, or three of different sizes (one upright), with the model and coefficients of `distortion`."""
    w, h = size
    sizes = [(w, h), (w * 5 // 6, h * 9 // 8), (h, w)] if mixed_sizes else [(w, h)]
    out = []
    for i, (width, height) in enumerate(sizes):
        ox, oy = ((0.11, -0.08), (-0.07, 0.09), (0.05, 0.12))[i] if principal_point_offset else (0.0, 0.0)
        f, cx, cy = 1.05 * max(w, h) * (1 + 0.04 * i), width * (0.5 + ox), height * (0.5 + oy)
        if distortion is None:
            out.append(Lens("PINHOLE", width, height, (f, f * 1.01, cx, cy)))
        else:
            focal = 1 if distortion.model in ("SIMPLE_RADIAL", "RADIAL", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE") else 2
            out.append(Lens(distortion.model, width, height, (*[f] * focal, cx, cy, *distortion.params[focal + 2 :])))
    return out


def make_capture(
    folder: Path,
    views: int = 12,
    size: tuple[int, int] = (96, 64),
    seed: int = 0,
    mixed_sizes: bool = True,
    principal_point_offset: bool = True,
    distortion: Lens | None = None,
    *,
    points: int = 1500,
    scale: float = 1.0,
    text: bool = False,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Synthetic:
    """Write a COLMAP capture to `folder`: images/*.png and sparse/0/*.bin (or .txt), and return the ground truth.

    scale: Factor by which the scene is enlarged. background: Colour behind the scene; load the capture with the same one.
    """
    rng = np.random.default_rng(seed)
    kinds = lenses(size, mixed_sizes, principal_point_offset, distortion)
    posed, images = [], {}
    for i in range(views):
        angle = 2 * np.pi * (i + 0.3 * rng.random()) / views
        eye = np.array([3.6 * np.cos(angle), 3.6 * np.sin(angle), 1.6 + 1.4 * rng.random()])
        pose = look_at(eye, np.array([0.05, -0.05, 0.2]), 0.15 * rng.standard_normal())
        pose[:3, 3] *= scale
        t = pose[:3, 3]
        image = ColmapImage(
            i + 1, f"view_{i:03d}.png", quaternion(pose[:3, :3]), (float(t[0]), float(t[1]), float(t[2])), i % len(kinds) + 1
        )
        posed.append(image)
        images[image.name] = np.rint(picture(kinds[i % len(kinds)], pose, scale, background) * 255).astype(np.uint8)
    xyz = surface_points(points, rng)
    rgb = np.rint(colours(xyz) * 255).astype(np.uint8)
    cameras = {i + 1: lens for i, lens in enumerate(kinds)}
    ids = np.arange(1, len(xyz) + 1)
    model = Model(cameras, tuple(posed), ids, xyz * scale, rgb, np.full(len(xyz), 0.5))
    write_model(folder / "sparse" / "0", model, text=text)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    for name, pixels in images.items():
        Image.fromarray(pixels).save(folder / "images" / name)
    return Synthetic(folder, model, images, scale, background)


def surface_points(count: int, rng: np.random.Generator) -> Array:
    """Return points [count, 3] on the visible surfaces, unscaled and spread about evenly by area."""
    areas = [16.0, *(4 * np.pi * radius**2 for _, radius, _ in _BALLS), 2.0]
    share = rng.choice(len(areas), count, p=np.array(areas) / sum(areas))
    out = np.concatenate((rng.uniform(-_HALF, _HALF, (count, 2)), np.zeros((count, 1))), 1)
    for i, (centre, radius, _) in enumerate(_BALLS, start=1):
        way = rng.standard_normal((count, 3))
        ball = np.array(centre) + radius * way / np.linalg.norm(way, axis=1, keepdims=True)
        out = np.where((share == i)[:, None], ball, out)
    low, high = np.array(_BOX[0]), np.array(_BOX[1])
    box = low + rng.random((count, 3)) * (high - low)
    side = rng.integers(0, 5, count)  # four walls and the lid
    for axis, end, which in ((0, low, 0), (0, high, 1), (1, low, 2), (1, high, 3), (2, high, 4)):
        box[side == which, axis] = end[axis]
    return np.where((share == len(areas) - 1)[:, None], box, out)


def opengl(world_to_cam: Array) -> list[list[float]]:
    """Return the camera-to-world matrix with OpenGL axes, as in transforms*.json."""
    pose = np.linalg.inv(world_to_cam)
    pose[:3, 1:3] *= -1
    return pose.tolist()


def make_nerfstudio(folder: Path, **options: object) -> Synthetic:
    """Write the same capture as transforms.json with intrinsics for every frame, and its points as a PLY file."""
    made = make_capture(folder, **options)  # pyright: ignore[reportArgumentType]
    frames = []
    for image in made.model.images:
        lens = made.model.cameras[image.camera_id]
        frame = {"file_path": f"images/{image.name}", "transform_matrix": opengl(image.world_to_cam()), "w": lens.width, "h": lens.height}
        frame |= {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, "camera_model": lens.model}
        frame |= {name: lens.value(name) for name in ("k1", "k2", "k3", "k4", "p1", "p2")}
        frames.append(frame)
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, "ply_file_path": "sparse_pc.ply"}))
    header = f"ply\nformat ascii 1.0\nelement vertex {len(made.model.xyz)}\n"
    header += "".join(f"property double {axis}\n" for axis in "xyz") + "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    rows = [" ".join(map(repr, [*map(float, p), *map(int, c)])) for p, c in zip(made.model.xyz, made.model.rgb)]
    (folder / "sparse_pc.ply").write_text(header + "end_header\n" + "\n".join(rows) + "\n")
    for path in (folder / "sparse" / "0").iterdir():
        path.unlink()
    return made


def make_blender(folder: Path, views: int = 6, size: int = 64, seed: int = 0) -> Synthetic:
    """Write a NeRF-synthetic capture: square RGBA pictures that are transparent where rays miss the scene. Every third is a test view."""
    made = make_capture(folder, views, (size, size), seed, mixed_sizes=False, principal_point_offset=False)
    width = 2 * np.arctan(0.5 * size / made.model.cameras[1].fx)
    lens = Lens("SIMPLE_PINHOLE", size, size, (made.model.cameras[1].fx, size / 2, size / 2))
    frames: dict[str, list[dict]] = {"train": [], "test": []}
    images = {}
    for i, image in enumerate(made.model.images):
        part, pose = ("test" if i % 3 == 0 else "train"), image.world_to_cam()
        black, white = (picture(lens, pose, 1.0, (shade,) * 3) for shade in (0.0, 1.0))
        alpha = np.clip(1 - (white - black).mean(-1, keepdims=True), 0, 1)
        rgba = np.concatenate((black / np.maximum(alpha, 1e-6), alpha), -1)
        name = f"{part}/r_{i}.png"
        (folder / part).mkdir(exist_ok=True)
        images[name] = np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8)
        Image.fromarray(images[name]).save(folder / name)
        frames[part].append({"file_path": f"./{part}/r_{i}", "transform_matrix": opengl(pose)})
    for part, rows in frames.items():
        (folder / f"transforms_{part}.json").write_text(json.dumps({"camera_angle_x": float(width), "frames": rows}))
    for path in (*(folder / "sparse" / "0").iterdir(), *(folder / "images").iterdir()):
        path.unlink()
    return Synthetic(folder, made.model, images, 1.0, (0.0, 0.0, 0.0))
