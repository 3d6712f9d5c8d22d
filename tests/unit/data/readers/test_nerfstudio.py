"""nerfstudio captures: transforms.json with its lenses, masks and split."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import write_model
from scene_experts.data.summary import summarise
from support.captures import load
from support.depths import make_depths
from support.lenses import LENSES
from support.synthetic import make_capture, make_nerfstudio, picture


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


@pytest.mark.parametrize("outside", ["../photos", "{}/photos"])
def test_results_of_photographs_elsewhere_stay_inside_the_run(tmp_path: Path, outside: str) -> None:
    """Results are written under the names of views, so a name with a root or ".." would overwrite the photograph itself."""
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


def test_photographs_whose_results_would_have_the_same_name(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path / "c", views=3, size=(24, 16), points=50)
    (tmp_path / "images").mkdir()
    (tmp_path / "images/view_000.png").write_bytes((tmp_path / "c/images/view_000.png").read_bytes())
    edit(tmp_path / "c/transforms.json", lambda m: m["frames"][1].update(file_path="../images/view_000.png"))
    with pytest.raises(InputError, match=r"images/view_000\.png"):
        load(tmp_path / "c")


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


def test_an_absent_mask_is_told(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=3, size=(24, 16), points=50)
    edit(tmp_path / "transforms.json", lambda m: [f.update(mask_path=f"./stencils/{i}.png") for i, f in enumerate(m["frames"])])
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.zeros((16, 24), np.uint8)).save(tmp_path / "masks/view_001.png")  # found by its name
    told = [w for w in load(tmp_path).warnings if "mask" in w]
    assert "3 masks" in told[0] and "./stencils/0.png" in told[0] and told[1].startswith("2 of 3 photographs have no mask")


def test_names_of_held_out_frames_are_compared_as_paths(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=6, size=(24, 16), points=50)
    path = tmp_path / "transforms.json"
    edit(path, lambda m: m.update(test_filenames=["./images/view_001.png", "images\\view_003.png", "images/gone.png"]))
    capture = load(tmp_path)
    assert (capture.split, capture.test) == ("files", (1, 3))
    assert any("1 of 3" in w and "test_filenames" in w and "gone.png" in w for w in capture.warnings)
    edit(path, lambda m: m.update(val_filenames=["images/view_004.png", "images/view_003.png"]))
    capture = load(tmp_path)
    assert capture.test == (1, 3) and any("1 validation" in w for w in capture.warnings)
    edit(path, lambda m: m.pop("test_filenames"))
    capture = load(tmp_path)
    assert (capture.split, capture.test) == ("files", (3, 4)) and not any("filenames" in w for w in capture.warnings)
    edit(path, lambda m: m.update(train_filenames=["images/view_000.png", "./images/view_001.png", "images/view_002.png"]))
    capture = load(tmp_path)
    assert capture.train == (0, 1, 2, 5) and any("1 of 6 frames" in w and "images/view_005.png" in w for w in capture.warnings)


def test_a_folder_of_two_kinds_says_which_is_read(tmp_path: Path) -> None:
    made = make_nerfstudio(tmp_path, views=3, size=(24, 16), points=50)
    assert not any("also holds" in w for w in load(tmp_path).warnings)
    write_model(tmp_path / "colmap/sparse/0", made.model)
    capture = load(tmp_path)
    assert capture.kind == "colmap"
    assert sum("COLMAP" in w and "also holds transforms.json" in w for w in capture.warnings) == 1


def test_auto_uses_the_split_that_the_file_states(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=5, size=(24, 16), points=50)
    edit(tmp_path / "transforms.json", lambda m: m.update(test_filenames=["images/view_001.png", "images/view_003.png"]))
    capture = load(tmp_path)
    assert (capture.split, capture.test, capture.train) == ("files", (1, 3), (0, 2, 4))
    assert load(tmp_path, split="mod8").test == (0,)
    edit(tmp_path / "transforms.json", lambda m: m.pop("test_filenames"))
    with pytest.raises(InputError, match=r"--split files.*nerfstudio"):
        load(tmp_path, split="files")


@pytest.mark.parametrize(
    "elsewhere", [lambda name: f"images/{name[:-4]}.JPG", lambda name: f"C:\\data\\images\\{name}", lambda name: f"/no/such/{name}"]
)
def test_photographs_that_are_called_otherwise_are_found_and_told(tmp_path: Path, elsewhere) -> None:
    make_nerfstudio(tmp_path, views=3, size=(24, 16), points=50)
    (tmp_path / "depth").mkdir()
    for path in (tmp_path / "images").iterdir():  # of the same names: not the photographs
        Image.fromarray(np.zeros((16, 24), np.uint8)).save(tmp_path / "depth" / path.name)
    plain = load(tmp_path)
    edit(tmp_path / "transforms.json", lambda m: [f.update(file_path=elsewhere(Path(f["file_path"]).name)) for f in m["frames"]])
    capture = load(tmp_path)
    assert [v.name for v in capture.views] == [v.name for v in plain.views] and [v.path for v in capture.views] == [
        v.path for v in plain.views
    ]
    assert any(w.startswith("3 images") for w in capture.warnings)


def test_files_beside_photographs_may_have_paths_of_windows(tmp_path: Path) -> None:
    make_depths(tmp_path, cloud=True)
    (tmp_path / "stencils").mkdir()
    (tmp_path / "cloud.ply").rename(tmp_path / "stencils/cloud.ply")
    Image.fromarray(np.zeros((48, 64), np.uint8)).save(tmp_path / "stencils/0.png")

    def change(meta) -> None:
        meta.update(ply_file_path="stencils\\cloud.ply")
        meta["frames"][0].update(mask_path="stencils\\0.png", depth_file_path="depth\\0.png")

    edit(tmp_path / "transforms.json", change)
    capture = load(tmp_path)
    assert not any("absent" in warning for warning in capture.warnings)
    assert capture.frame(0).mask is not None and capture.views[0].depth is not None and capture.points is not None


@pytest.mark.parametrize("model", ["PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE"])
def test_distortion_counts_whatever_the_lens_is_called(tmp_path: Path, model: str) -> None:
    make_nerfstudio(tmp_path, views=3, size=(96, 64), points=50, distortion=LENSES[4])
    edit(tmp_path / "transforms.json", lambda m: [f.update(camera_model=model) for f in (m, *m["frames"])])
    assert summarise(load(tmp_path))["undistorted"] == 3
