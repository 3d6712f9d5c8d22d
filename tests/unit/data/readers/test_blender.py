"""NeRF-synthetic captures: their split, background and random points."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.lens import Lens
from support.captures import load
from support.synthetic import make_blender, picture


def test_split_pose_and_background(tmp_path: Path) -> None:
    made = make_blender(tmp_path)
    capture = load(tmp_path, init="random", normalise="none")
    assert capture.kind == "blender" and capture.split == "files"
    assert [capture.views[i].name for i in capture.test] == ["test/r_0.png", "test/r_3.png"]
    assert capture.background == (1.0, 1.0, 1.0) and any("--background" in w for w in capture.warnings)
    poses = {f"{'test' if i % 3 == 0 else 'train'}/r_{i}.png": image.world_to_cam() for i, image in enumerate(made.model.images)}
    for view in capture.views:
        np.testing.assert_allclose(view.camera.world_to_cam, poses[view.name], atol=1e-6)
        assert view.camera.fx == pytest.approx(made.model.cameras[1].fx, rel=1e-6)
    for colour in ((1.0, 1.0, 1.0), (0.0, 0.0, 0.0), (0.2, 0.4, 0.9)):
        capture = load(tmp_path, init="random", normalise="none", background=colour)
        frame = capture.frame(1)
        lens = Lens("SIMPLE_PINHOLE", 64, 64, (made.model.cameras[1].fx, 32, 32))
        truth = picture(lens, poses[capture.views[1].name], 1.0, colour)
        assert frame.mask is None and np.abs(frame.rgb.numpy() - 255 * truth).max() < 2.0
        assert capture.background == colour


@pytest.mark.parametrize("words", [{"images": "train"}, {"resolution": "inria:2"}])
def test_another_image_folder_is_refused(tmp_path: Path, words: dict) -> None:
    make_blender(tmp_path)
    (tmp_path / "images_2").mkdir()
    with pytest.raises(InputError, match="--images"):
        load(tmp_path, init="random", **words)


def test_random_points_fill_the_cube_of_3dgs(tmp_path: Path) -> None:
    make_blender(tmp_path)
    capture = load(tmp_path, init="random")
    assert capture.points is not None and len(capture.points.xyz) == 10_000
    xyz = capture.world.to_input(capture.points.xyz)
    assert -1.3 <= float(xyz.min()) < -1.29 and 1.29 < float(xyz.max()) <= 1.3
    unasked = load(tmp_path)
    assert torch.equal(unasked.points.xyz, capture.points.xyz) and any("10,000" in w for w in unasked.warnings)


def test_broken_json(tmp_path: Path) -> None:
    make_blender(tmp_path, views=3, size=16)
    (tmp_path / "transforms_train.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        load(tmp_path, init="random")


def test_opaque_photographs_are_on_the_background_of_other_captures(tmp_path: Path) -> None:
    make_blender(tmp_path)
    for path in tmp_path.glob("t*/*.png"):
        Image.open(path).convert("RGB").save(path)
    capture = load(tmp_path, init="random")
    assert capture.background == (0.0, 0.0, 0.0) and not any("--background" in w for w in capture.warnings)
    assert load(tmp_path, init="random", background=(1.0, 1.0, 1.0)).background == (1.0, 1.0, 1.0)


@pytest.mark.parametrize("away", [(30.0, 0.0, 0.0), (0.0, -8.0, 2.0)])
def test_random_points_lie_before_cameras_that_look_elsewhere(tmp_path: Path, away: tuple[float, float, float]) -> None:
    """Then the cube at the origin is not where the subject is."""
    make_blender(tmp_path)
    for path in tmp_path.glob("transforms_*.json"):
        meta = json.loads(path.read_text())
        for frame in meta["frames"]:
            for axis in range(3):
                frame["transform_matrix"][axis][3] += away[axis]
        path.write_text(json.dumps(meta))
    capture = load(tmp_path, init="random")
    xyz = capture.world.to_input(capture.points.xyz)
    assert np.abs(xyz.mean(0).numpy() - away).max() < 2.5
