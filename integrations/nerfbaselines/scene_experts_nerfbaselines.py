"""scene-experts as a method of nerfbaselines, through its Python API.

A checkpoint holds a run folder, and the capture's cameras with black pictures in place of its photographs: a run draws any
camera with them. Written for nerfbaselines 1.2, which needs numpy < 2.
"""

from __future__ import annotations

import ast
import math
import shutil
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfbaselines import Method, camera_model_to_int
from PIL import Image

import scene_experts as se
from scene_experts.geometry.rotation import matrix_to_quat

RUN, CAPTURE = "run", "capture"  # folders of a checkpoint
NAMES = "{:05d}.png"


class SceneExperts(Method):
    """A recipe of scene-experts. `config_overrides` holds `recipe` (default "scene-experts") and numbers by their names on the
    command line: {"recipe": "moe-gs", "iterations": 7000, "scene.voxel_size": 0.01}."""

    def __init__(self, *, checkpoint=None, train_dataset=None, config_overrides=None):
        self._checkpoint = None if checkpoint is None else Path(checkpoint)
        self._trainer = self._run = None
        self._temporary = tempfile.TemporaryDirectory(prefix="scene-experts-")
        if self._checkpoint is not None:
            self._run = se.open_run(self._checkpoint / RUN, data=self._checkpoint / CAPTURE)
            return
        numbers = {name: _value(value) for name, value in (config_overrides or {}).items()}
        recipe = se.recipe(numbers.pop("recipe", "scene-experts"), **numbers)
        self._dataset = train_dataset
        folder = Path(self._temporary.name) / CAPTURE
        write_capture(train_dataset, folder, photographs=True)
        capture = se.load_capture(folder, resolution="as-is", split="none", background=_background(train_dataset), seed=recipe.seed)
        self._trainer = se.Trainer(recipe, capture, log_every=1, preview_every=0, save_every=1_000_000)

    @classmethod
    def get_method_info(cls):
        return {
            "method_id": "scene-experts",
            "required_features": frozenset(("color", "points3D_xyz", "points3D_rgb")),
            "supported_camera_models": frozenset(("pinhole",)),
            "supported_outputs": ("color", {"name": "depth", "type": "depth"}, "accumulation"),
            "can_resume_training": False,
        }

    def get_info(self):
        recipe = self._trainer.recipe if self._trainer else self._run.recipe
        return {
            **self.get_method_info(),
            "num_iterations": recipe.iterations,
            "loaded_step": self._run.step if self._checkpoint else None,
            "loaded_checkpoint": str(self._checkpoint) if self._checkpoint else None,
            "hparams": {"recipe": recipe.recipe, "iterations": recipe.iterations, "seed": recipe.seed},
        }

    def train_iteration(self, step):
        """Train iteration `step` + 1 and return its loss and the PSNR of its view, dB."""
        if self._trainer is None:
            raise RuntimeError("expected a method made from a dataset, found one from a checkpoint, which cannot be trained further")
        self._run = None
        for event in self._trainer:
            if isinstance(event, se.Stepped) and event.step > step:
                return {"loss": float(sum(event.terms.values())), "psnr": float(event.psnr), "num_anchors": float(event.anchors)}
        return {}

    def save(self, path):
        """Write a checkpoint into the folder `path`."""
        out = Path(path)
        if self._checkpoint is not None:
            shutil.copytree(self._checkpoint, out, dirs_exist_ok=True)
            return
        self._trained().save(out / RUN)
        write_capture(self._dataset, out / CAPTURE, photographs=False)

    def render(self, camera, *, options=None):
        """The picture, depth and opacity that one pinhole camera sees, float32."""
        camera = camera.item()
        if camera.camera_models != camera_model_to_int("pinhole"):
            raise ValueError("expected a pinhole camera, found another; supported_camera_models says so")
        fx, fy, cx, cy = map(float, camera.intrinsics)
        width, height = map(int, camera.image_sizes)
        view = se.Camera.from_pose(camera.poses[:3].astype(np.float64), width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
        layers = self._trained().render_layers(view)
        return {"color": layers.image, "depth": layers.depth, "accumulation": layers.alpha}

    def get_train_embedding(self, index):
        return None

    def get_embedding(self, index):
        return None

    def optimize_embedding(self, dataset, *, embedding=None):
        raise NotImplementedError("expected a method with appearance embeddings, found scene-experts; score it without them")

    def close(self):
        self._temporary.cleanup()

    def _trained(self):
        if self._run is None:
            self._run = self._trainer.run
        return self._run


def write_capture(dataset: Any, folder: Path, photographs: bool) -> None:
    """Write a dataset of nerfbaselines as a COLMAP capture: pictures, cameras, points. Without `photographs`, the pictures are black."""
    sparse, images = folder / "sparse" / "0", folder / "images"
    for place in (sparse, images):
        place.mkdir(parents=True, exist_ok=True)
    cameras, poses = dataset["cameras"], []
    lines = []
    for i in range(len(cameras)):
        width, height = map(int, cameras.image_sizes[i])
        lines.append(f"{i + 1} PINHOLE {width} {height} " + " ".join(repr(float(v)) for v in cameras.intrinsics[i]))
        pose = cameras.poses[i].astype(np.float64)
        rotation = pose[:3, :3].T
        quaternion = matrix_to_quat(torch.from_numpy(rotation.copy())).tolist()
        values = [*quaternion, *(-rotation @ pose[:3, 3]).tolist()]
        poses += [f"{i + 1} " + " ".join(map(repr, values)) + f" {i + 1} {NAMES.format(i)}", ""]
        pixels = _photograph(dataset, i, width, height) if photographs else np.zeros((height, width, 3), np.uint8)
        Image.fromarray(pixels).save(images / NAMES.format(i), compress_level=1)
        if photographs and dataset.get("masks") is not None:
            mask = np.asarray(dataset["masks"][i])[:height, :width]
            Image.fromarray(((mask > 0) * 255).astype(np.uint8)).save(images / NAMES.format(i).replace(".png", "_mask.png"))
    (sparse / "cameras.txt").write_text("\n".join(lines) + "\n")
    (sparse / "images.txt").write_text("\n".join(poses) + "\n")
    xyz = np.asarray(dataset["points3D_xyz"], np.float64)
    rgb = np.asarray(dataset["points3D_rgb"], np.uint8)
    points = [f"{i + 1} {' '.join(map(repr, p))} {' '.join(map(str, c))} 0.0" for i, (p, c) in enumerate(zip(xyz.tolist(), rgb.tolist()))]
    (sparse / "points3D.txt").write_text("\n".join(points) + "\n")


def _photograph(dataset: Any, index: int, width: int, height: int) -> np.ndarray:
    pixels = np.asarray(dataset["images"][index])[:height, :width]
    if pixels.dtype != np.uint8:
        pixels = np.clip(np.rint(pixels * 255), 0, 255).astype(np.uint8)
    if pixels.shape[2] == 4:
        alpha, behind = pixels[..., 3:] / 255, np.array(_background(dataset) or (0, 0, 0)) * 255
        pixels = np.rint(pixels[..., :3] * alpha + behind * (1 - alpha)).astype(np.uint8)
    return np.ascontiguousarray(pixels)


def _background(dataset: Any) -> tuple[float, ...] | None:
    """RGB in [0, 1] behind the scene, where the dataset states it."""
    colour = dataset["metadata"].get("background_color")
    if colour is None:
        return None
    found = np.asarray(colour)
    return tuple(float(v) for v in (found / 255 if found.dtype == np.uint8 else found))


def _value(value: Any) -> Any:
    """A value of the command line `--set NAME=VALUE`: a number where it is one."""
    if not isinstance(value, str):
        return value
    try:
        found = ast.literal_eval(value)
    except (ValueError, SyntaxError):
        return value
    return value if isinstance(found, float) and not math.isfinite(found) else found
