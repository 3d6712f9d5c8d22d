"""Captures as the Python API shows them."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import scene_experts as se
from scene_experts.data.readers.colmap_model import read_model, write_model
from support.messages import naming
from support.synthetic import make_capture


def test_a_capture_is_in_its_own_frame_and_unit(folder, capture):
    model = read_model(folder / "sparse" / "0")
    xyz, rgb = capture.points
    assert np.allclose(np.sort(xyz, 0), np.sort(model.xyz, 0)) and rgb.dtype == np.uint8
    poses = {image.name: image.world_to_cam() for image in model.images}
    for name, camera in zip(capture.names, capture.cameras, strict=True):
        assert np.allclose(camera.world_to_camera, poses[name], atol=1e-5) and capture.names[camera.view] == name
    assert len(capture.train_cameras) == 7 and [c.view for c in capture.test_cameras] == [0, 8]
    assert capture.name == "balls" and capture.path == folder and capture.background == (0.0, 0.0, 0.0)
    assert "7 training views" in repr(capture)


@pytest.mark.parametrize("kind", [str, Path])
def test_points_of_another_file_and_another_reconstruction(folder, tmp_path, kind):
    model = read_model(folder / "sparse" / "0")
    few = replace(model, ids=model.ids[:9], xyz=model.xyz[:9], rgb=model.rgb[:9], error=model.error[:9], images=model.images[:4])
    shutil.copytree(folder, tmp_path / "balls")
    write_model(tmp_path / "balls/sparse/1", few)
    assert len(se.load_capture(tmp_path / "balls", model="sparse/1").cameras) == 4
    xyz, _ = se.load_capture(tmp_path / "balls", points=kind(tmp_path / "balls/sparse/1/points3D.bin")).points
    assert np.allclose(xyz, few.xyz)
    with pytest.raises(se.InputError, match="nowhere"):
        se.load_capture(folder, points=kind("nowhere.ply"))


def test_photographs_are_the_files(folder, capture):
    file = np.asarray(Image.open(folder / "images" / capture.names[1]), np.float32) / 255
    photo = capture.photo(1)
    assert photo.dtype == np.float32 and np.array_equal(photo, file) and np.array_equal(capture.photo(capture.cameras[1]), photo)
    assert photo.shape == (capture.cameras[1].height, capture.cameras[1].width, 3) and capture.mask(1) is None
    for wrong in (9, -1, capture.look_at((9, 9, 9))):
        with pytest.raises(se.InputError, match=naming(0, 8)):
            capture.photo(wrong)


def test_photographs_are_left_out_by_name(folder, capture):
    left = se.load_capture(folder, leave_out=["view_002", "view_000.png"])
    assert left.names == [name for name in capture.names if name not in ("view_000.png", "view_002.png")]
    assert left.data.leave_out == ("view_002", "view_000.png")
    for wrong in ("view_002", [2], {"view_002"}):
        with pytest.raises(se.InputError, match="leave_out"):
            se.load_capture(folder, leave_out=wrong)


def test_masks_are_between_0_and_1(folder, tmp_path):
    shutil.copytree(folder, tmp_path / "masked")
    name = "view_001"
    with Image.open(tmp_path / f"masked/images/{name}.png") as photo:
        left = Image.new("L", photo.size, 255)
        left.paste(0, (0, 0, 5, photo.height))
        left.save(tmp_path / f"masked/images/{name}_mask.png")
    mask = se.load_capture(tmp_path / "masked").mask(1)
    assert mask is not None and mask.dtype == np.float32 and (mask[:, :5] == 0).all() and (mask[:, 5:] == 1).all()


def test_a_new_camera_takes_the_lens_of_the_photographs(capture):
    camera = capture.look_at((8, 0, 4))
    assert np.allclose(camera.position, (8, 0, 4)) and camera.view == -1
    middle = camera.K @ (camera.world_to_camera @ np.append(capture.centre, 1))[:3]
    assert np.allclose(middle[:2] / middle[2], (camera.width / 2, camera.height / 2))
    assert (camera.width, camera.height) in {(c.width, c.height) for c in capture.cameras}
    assert capture.up @ (0, 0, 1) > 0.9 and np.linalg.norm(capture.up) == pytest.approx(1)
    small = capture.look_at((8, 0, 4), (1, 1, 1), (0, 1, 0), size=(20, 10), fov=33)
    assert (small.width, small.height, round(small.fov)) == (20, 10, 33)


@pytest.mark.parametrize("size", [320, (32,), (32, 24.5), "32x24", np.zeros((2, 2)), (0, 24)])
def test_a_size_that_is_none_is_named(capture, size):
    for call in (lambda: capture.look_at((9, 9, 9), size=size), lambda: capture.camera_path(frames=2, size=size)):
        with pytest.raises(se.InputError, match=r"in px|width and a height"):
            call()
    for good in ((32, 24), np.array([32, 24])):
        assert capture.look_at((9, 9, 9), size=good).width == 32


def test_an_orbit_goes_around_the_centre(capture):
    cameras = capture.camera_path("orbit", frames=5, size=(20, 10))
    away = [np.linalg.norm(camera.position - capture.centre) for camera in cameras]
    assert len(cameras) == 5 and np.allclose(away, away[0]) and {(c.width, c.height) for c in cameras} == {(20, 10)}
    assert len(capture.camera_path(frames=3)) == 3
    for kind, frames, said in (
        ("zigzag", 3, "kind"),
        ("test", 3, "kind among auto, orbit, spiral, views,"),
        ("orbit", 0, "frames"),
        ("orbit", 2.5, "frames"),
    ):
        with pytest.raises(se.InputError, match=said):
            capture.camera_path(kind, frames=frames)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"missing": "skip"}, "missing"),
        ({"normalise": "no"}, "normalise"),
        ({"init": "sfm"}, "init"),
        ({"split": "half"}, "split"),
        ({"resolution": "huge"}, "resolution"),
        ({"background": (0.0, 0.0, 2.0)}, "background"),
        ({"near": -1.0}, "near"),
        ({"near": "0.1"}, "near.*'0.1'"),
        ({"ignore_principal_point": 1}, "ignore_principal_point"),
        ({"background": (0, 0)}, "background"),
        ({"background": "white"}, "background"),
        ({"max_views": 0}, "max_views"),
        ({"max_views": "5"}, "max_views.*'5'"),
        ({"seed": -1, "init": "random"}, "seed.*-1"),
        ({"images": "images_8"}, "images_8"),
    ],
)
def test_arguments_that_cannot_be_used_are_named(folder, arguments, said):
    with pytest.raises(se.InputError, match=said) as error:
        se.load_capture(folder, **arguments)
    assert "\n" not in str(error.value)
    with pytest.raises(se.InputError, match="absent"):
        se.load_capture(folder / "absent")


def test_random_points_follow_the_seed(folder, capture):
    random = se.load_capture(folder, init="random")
    assert random.with_seed(0) is random and capture.with_seed(3) is capture
    other = random.with_seed(3)
    assert not np.array_equal(other.points[0], random.points[0])
    assert np.array_equal(other.points[0], se.load_capture(folder, init="random", seed=3).points[0])


def test_random_points_of_a_capture_without_points_follow_the_seed(folder, capture):
    loaded = replace(capture.loaded, random_points=True, bounds=None)  # as poses of Metashape without a cloud
    assert type(capture)(capture.data, loaded, 0, capture.numbers).with_seed(3).seed == 3


def test_a_resolution_that_is_no_text_is_refused():
    with pytest.raises(se.InputError, match="resolution"):
        se.load_capture("anywhere", resolution=64)  # type: ignore[arg-type]


def test_a_camera_of_another_capture_has_no_photograph_here(tmp_path):
    folder = make_capture(tmp_path / "c", views=12, mixed_sizes=False).folder
    whole, six = se.load_capture(folder), se.load_capture(folder, max_views=6)
    with pytest.raises(se.InputError, match="other views"):
        whole.photo(six.cameras[3])
    for i, camera in enumerate(whole.cameras):
        assert np.array_equal(whole.photo(camera), whole.photo(i)) and np.array_equal(whole.photo(whole.names[i]), whole.photo(i))
    assert np.array_equal(whole.photo(six.cameras[0]), six.photo(0))  # the same view of both
    for wrong in ("none.png", None, 1.5):
        with pytest.raises(se.InputError, match="Capture"):
            whole.photo(wrong)


@pytest.mark.parametrize(
    "call",
    [
        lambda: se.load_capture(None),
        lambda: se.recipe(None),
        lambda: se.make("x", "y", minutes="10"),
        lambda: se.make("x", "y", options={"frames": 30}),
        lambda: se.load_capture(""),
        lambda: se.open_run(None),
        lambda: se.open_run("x", step="60"),
    ],
)
def test_arguments_of_another_kind_are_told_in_one_sentence(call):
    with pytest.raises(se.InputError, match="expected"):
        call()
