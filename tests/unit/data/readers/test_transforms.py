"""NeRF-synthetic and nerfstudio captures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.capture import load
from scene_experts.data.lens import Lens
from scene_experts.data.summary import summarise
from support.synthetic import make_blender, make_capture, make_nerfstudio, picture
from unit.data.test_lens import LENSES


def edit(path: Path, change) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def test_nerfstudio_is_the_same_capture_as_colmap(tmp_path: Path) -> None:
    make_capture(tmp_path / "a", views=5, size=(48, 32), points=200)
    make_nerfstudio(tmp_path / "b", views=5, size=(48, 32), points=200)
    a, b = load(tmp_path / "a"), load(tmp_path / "b")
    assert b.kind == "nerfstudio" and [v.name for v in b.views] == [f"images/{v.name}" for v in a.views]
    assert (a.train, a.test, a.split) == (b.train, b.test, b.split)
    for v, w in zip(a.views, b.views):
        torch.testing.assert_close(v.camera.world_to_cam, w.camera.world_to_cam, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(v.camera.K, w.camera.K)
        assert torch.equal(a.frame(v.camera.id).rgb, b.frame(w.camera.id).rgb)
    assert a.points is not None and b.points is not None
    torch.testing.assert_close(a.points.xyz, b.points.xyz)
    assert torch.equal(a.points.rgb, b.points.rgb)


@pytest.mark.parametrize("index", [4, 5], ids=["OPENCV", "OPENCV_FISHEYE"])
def test_distorted_frames_are_undistorted(tmp_path: Path, index: int) -> None:
    made = make_nerfstudio(tmp_path, views=3, size=(96, 64), points=50, distortion=LENSES[index])
    capture = load(tmp_path, split="none", normalise="none")
    for view in capture.views:
        camera = view.camera
        flat = Lens("PINHOLE", camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy))
        truth = picture(flat, camera.world_to_cam.double().numpy(), 1.0, made.background)
        error = np.abs(capture.frame(camera.id).rgb.numpy() / 255 - truth)
        assert np.median(error) < 0.006 and error.mean() < 0.03
    assert summarise(capture)["undistorted"] == 3


def test_frames_without_a_file_are_dropped_and_counted(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=5, size=(48, 32), points=50)
    (tmp_path / "images/view_002.png").unlink()
    capture = load(tmp_path)
    assert len(capture.views) == 4
    assert "1 of 5 frames dropped: their image is absent (first: images/view_002.png)" in capture.warnings
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="found none of them"):
        load(tmp_path)


@pytest.mark.parametrize("outside", ["../photos", "{}/photos"])
def test_photographs_elsewhere_keep_their_results_inside(tmp_path: Path, outside: str) -> None:
    """Results are written under the names of views: a name with a root or ".." would overwrite the photograph itself."""
    make_nerfstudio(tmp_path / "c", views=3, size=(24, 16), points=50)
    (tmp_path / "c/images").rename(tmp_path / "photos")
    edit(
        tmp_path / "c/transforms.json",
        lambda m: [f.update(file_path=f["file_path"].replace("images", outside.format(tmp_path))) for f in m["frames"]],
    )
    capture = load(tmp_path / "c")
    for view in capture.views:
        assert view.path.samefile(tmp_path / "photos" / view.path.name) and view.name.endswith(f"photos/{view.path.name}")
        assert (tmp_path / "run" / view.name).resolve().is_relative_to(tmp_path / "run")


def test_photographs_whose_results_would_share_a_name(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path / "c", views=3, size=(24, 16), points=50)
    (tmp_path / "images").mkdir()
    (tmp_path / "images/view_000.png").write_bytes((tmp_path / "c/images/view_000.png").read_bytes())
    edit(tmp_path / "c/transforms.json", lambda m: m["frames"][1].update(file_path="../images/view_000.png"))
    with pytest.raises(InputError, match=r"two called images/view_000\.png"):
        load(tmp_path / "c")


def test_shared_intrinsics_and_an_angle_of_view(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=3, size=(48, 32), points=50, mixed_sizes=False)
    path = tmp_path / "transforms.json"

    def share(meta: dict) -> None:
        for frame in meta["frames"]:
            shared = {k: frame.pop(k) for k in list(frame) if k not in ("file_path", "transform_matrix")}
        meta.update(shared)

    before = load(tmp_path)
    edit(path, share)
    torch.testing.assert_close(load(tmp_path).views[1].camera.K, before.views[1].camera.K)

    def angle(meta: dict) -> None:
        for name in ("fl_x", "fl_y"):
            meta.pop(name)
        meta["camera_angle_x"] = 1.2

    edit(path, angle)
    camera = load(tmp_path).views[0].camera
    assert camera.fx == pytest.approx(24 / np.tan(0.6), rel=1e-6) and camera.cx == 24


def test_a_smaller_image_folder(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=3, size=(48, 32), points=50, mixed_sizes=False)
    (tmp_path / "images_2").mkdir()
    for path in (tmp_path / "images").iterdir():
        Image.open(path).resize((24, 16)).save(tmp_path / "images_2" / path.name)
    full, half = load(tmp_path), load(tmp_path, images="images_2")
    assert (half.views[0].camera.width, half.views[0].camera.height) == (24, 16)
    torch.testing.assert_close(half.views[0].camera.K[:2], full.views[0].camera.K[:2] / 2)


@pytest.mark.parametrize("place", ["masks/view_001.png", "masks/view_001.png.png", "images/view_001_mask.png", "stencils/one.png"])
def test_masks_of_nerfstudio(tmp_path: Path, place: str) -> None:
    made = make_nerfstudio(tmp_path, views=2, size=(48, 32), points=50)
    (tmp_path / place).parent.mkdir(exist_ok=True)
    Image.fromarray(np.zeros(made.images["view_001.png"].shape[:2], np.uint8)).save(tmp_path / place)
    if place.startswith("stencils"):
        edit(tmp_path / "transforms.json", lambda m: m["frames"][1].update(mask_path=place))
    capture = load(tmp_path)
    mask = capture.frame(1).mask
    assert mask is not None and not mask.any() and capture.frame(0).mask is None


def test_blender_split_pose_and_background(tmp_path: Path) -> None:
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


def test_blender_random_points_fill_its_cube_in_any_world(tmp_path: Path) -> None:
    make_blender(tmp_path)
    capture = load(tmp_path, init="random")
    assert capture.points is not None and len(capture.points.xyz) == 10_000
    xyz = capture.world.to_input(capture.points.xyz)
    assert -1.3 <= float(xyz.min()) < -1.29 and 1.29 < float(xyz.max()) <= 1.3
    unasked = load(tmp_path)
    assert torch.equal(unasked.points.xyz, capture.points.xyz) and "no 3D points: 10,000 random ones to start from" in unasked.warnings


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda m: m["frames"][0].update(transform_matrix=[[float("nan")] * 4] * 4), "transform_matrix"),
        (lambda m: m["frames"][0].update(transform_matrix="no"), "transform_matrix"),
        (lambda m: m["frames"][0].update(transform_matrix=(3 * np.eye(4)).tolist()), "rotation"),
        (lambda m: m["frames"][0].pop("transform_matrix"), "transform_matrix"),
        (lambda m: m["frames"][0].pop("file_path"), "file_path"),
        (lambda m: m["frames"][0].update(camera_model="EQUIRECTANGULAR"), "camera_model"),
        (lambda m: m["frames"][0].update(fl_x="wide"), "numbers"),
        (lambda m: m["frames"][0].pop("w"), "numbers"),
        (lambda m: m["frames"][0].update(w=float("inf")), "numbers"),
        (lambda m: m["frames"][0].pop("fl_x"), "fl_x, or camera_angle_x between 0 and pi.*found None"),
        (lambda m: (m["frames"][0].pop("fl_x"), m.update(camera_angle_x="wide")), "camera_angle_x.*found 'wide'"),
        (lambda m: m.update(test_filenames=5), "test_filenames"),
        (lambda m: m["frames"][1].update(file_path=m["frames"][0]["file_path"]), "twice"),
        (lambda m: m.update(frames=[]), "at least one frame"),
        (lambda m: m.pop("frames"), "list of frames"),
        (lambda m: m.update(ply_file_path="nowhere.ply"), r"nowhere\.ply"),
    ],
)
def test_bad_files(tmp_path: Path, change, word: str) -> None:
    make_nerfstudio(tmp_path, views=3, size=(24, 16), points=20)
    edit(tmp_path / "transforms.json", change)
    with pytest.raises(InputError, match=word):
        load(tmp_path)


def test_broken_json(tmp_path: Path) -> None:
    make_blender(tmp_path, views=3, size=16)
    (tmp_path / "transforms_train.json").write_text("{")
    with pytest.raises(InputError, match="JSON"):
        load(tmp_path, init="random")


def test_auto_takes_the_split_that_the_file_names(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=5, size=(24, 16), points=50)
    edit(tmp_path / "transforms.json", lambda m: m.update(test_filenames=["images/view_001.png", "images/view_003.png"]))
    capture = load(tmp_path)
    assert (capture.split, capture.test, capture.train) == ("files", (1, 3), (0, 2, 4))
    assert load(tmp_path, split="mod8").test == (0,)
    edit(tmp_path / "transforms.json", lambda m: m.pop("test_filenames"))
    with pytest.raises(InputError, match=r"--split files, found no test views in transforms\.json"):
        load(tmp_path, split="files")
