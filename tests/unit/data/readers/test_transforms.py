"""The frames of transforms*.json: their values, and every kind of invalid value."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from support.captures import load
from support.synthetic import make_nerfstudio


def edit(path: Path, change) -> None:
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))


def test_frames_without_a_file_are_dropped_and_counted(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=5, size=(48, 32), points=50)
    (tmp_path / "images/view_002.png").unlink()
    capture = load(tmp_path)
    assert len(capture.views) == 4
    assert any("images/view_002.png" in w for w in capture.warnings)
    for path in (tmp_path / "images").iterdir():
        path.unlink()
    with pytest.raises(InputError, match="5"):
        load(tmp_path)


def test_names_without_an_extension_and_one_in_capitals(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=3, size=(48, 32), points=50)
    for path in (tmp_path / "images").iterdir():
        path.rename(path.with_suffix(".PNG"))

    def cut(meta: dict) -> None:
        for frame in meta["frames"]:
            frame["file_path"] = frame["file_path"].removesuffix(".png")

    edit(tmp_path / "transforms.json", cut)
    assert [view.path.suffix for view in load(tmp_path).views] == [".PNG"] * 3


def test_shared_intrinsics_and_an_angle_of_view(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=3, size=(48, 32), points=50, mixed_sizes=False, principal_point_offset=False)
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


@pytest.mark.parametrize("given", [{}, {"w": None, "h": 0}, {"w": 48.0, "h": "32.0"}])
def test_frames_without_a_size_have_that_of_the_photograph(tmp_path: Path, given: dict) -> None:
    make_nerfstudio(tmp_path, views=3, size=(48, 32), points=50, mixed_sizes=False)
    path = tmp_path / "transforms.json"
    before = load(tmp_path)

    def forget(meta: dict) -> None:
        for frame in meta["frames"]:
            frame.pop("w"), frame.pop("h")
            frame.update(given)

    edit(path, forget)
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())  # a byte order mark
    after = load(tmp_path)
    assert all(torch.equal(a.camera.K, b.camera.K) and a.camera.width == b.camera.width for a, b in zip(before.views, after.views))


def test_a_size_of_an_upright_photograph_that_is_stored_on_its_side(tmp_path: Path) -> None:
    """The principal point tells whether the poses are those of the stored or of the upright picture."""
    make_nerfstudio(tmp_path, views=2, size=(24, 48), points=50, mixed_sizes=False)
    before = load(tmp_path)
    rgb = before.images.get(0)[0]
    edit(tmp_path / "transforms.json", lambda meta: [(frame.pop("w"), frame.pop("h")) for frame in meta["frames"]])
    for path in (tmp_path / "images").iterdir():
        picture, exif = Image.open(path).transpose(Image.Transpose.ROTATE_90), Image.Exif()
        exif[0x0112] = 6
        picture.save(path, exif=exif)
    after = load(tmp_path)
    assert [(v.camera.width, v.camera.height) for v in after.views] == [(v.camera.width, v.camera.height) for v in before.views]
    assert torch.equal(after.images.get(0)[0], rgb)


def test_a_size_that_is_no_whole_number(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=2, size=(24, 16), points=50)
    edit(tmp_path / "transforms.json", lambda meta: meta["frames"][0].update(w=24.5))
    with pytest.raises(InputError, match=r"24\.5"):
        load(tmp_path)


def test_the_fisheye_of_instant_ngp(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=2, size=(48, 32), points=20, mixed_sizes=False, principal_point_offset=False)
    path = tmp_path / "transforms.json"
    bends = {"k1": 0.02, "k2": -0.01, "k3": 0.003, "k4": -0.001}
    edit(path, lambda m: [(f.pop("camera_model", None), f.update(bends, is_fisheye=True)) for f in m["frames"]])
    edit(path, lambda m: m.pop("camera_model", None))
    lens = load(tmp_path).images.sources[0].lens
    assert lens.model == "OPENCV_FISHEYE" and lens.params[4:] == tuple(bends.values())
    edit(path, lambda m: [f.update(camera_model="FULL_OPENCV") for f in m["frames"]])  # a stated model counts
    assert load(tmp_path).images.sources[0].lens.model == "FULL_OPENCV"
    edit(path, lambda m: [f.update(camera_model="OPENCV") for f in m["frames"]])
    with pytest.raises(InputError, match="k4"):  # of nerfstudio or of OpenCV?
        load(tmp_path)


def test_two_angles_of_view_give_two_focal_lengths(tmp_path: Path) -> None:
    make_nerfstudio(tmp_path, views=2, size=(48, 32), points=20, mixed_sizes=False, principal_point_offset=False)
    path = tmp_path / "transforms.json"
    edit(path, lambda m: [[f.pop(name) for name in ("fl_x", "fl_y", "w", "h")] for f in m["frames"]])
    edit(path, lambda m: m.update(camera_angle_x=1.2, camera_angle_y=0.6))
    lens = load(tmp_path).images.sources[0].lens
    assert (lens.fx, lens.fy) == (pytest.approx(24 / np.tan(0.6)), pytest.approx(16 / np.tan(0.3)))
    edit(path, lambda m: m.update(camera_angle_y=round(2 * np.arctan(16 / lens.fx), 4)))  # of square pixels
    assert load(tmp_path).images.sources[0].lens.model == "SIMPLE_PINHOLE"
    edit(path, lambda m: m.update(camera_angle_y=4.0))
    with pytest.raises(InputError, match=r"camera_angle_y.*4"):
        load(tmp_path)


@pytest.mark.parametrize("sized", [True, False])
def test_an_angle_of_view_keeps_the_centre_and_the_distortion(tmp_path: Path, sized: bool) -> None:
    make_nerfstudio(tmp_path, views=2, size=(48, 32), points=20, mixed_sizes=False, principal_point_offset=False)
    path = tmp_path / "transforms.json"
    dropped = ("fl_x", "fl_y") if sized else ("fl_x", "fl_y", "w", "h")
    edit(path, lambda m: [[f.pop(name) for name in dropped] for f in m["frames"]])
    edit(path, lambda m: m.update(camera_angle_x=1.2))
    assert load(tmp_path).images.sources[0].lens.model == "SIMPLE_PINHOLE"  # its centre is that of the picture
    edit(path, lambda m: [f.update(camera_model="OPENCV", cx=20.0, k1=-0.1) for f in m["frames"]])
    lens = load(tmp_path).images.sources[0].lens
    assert (lens.model, lens.cx, lens.cy, lens.value("k1")) == ("OPENCV", 20.0, 16.0, -0.1)
    assert lens.fx == lens.fy == pytest.approx(24 / np.tan(0.6))


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda m: m["frames"][0].update(transform_matrix=[[float("nan")] * 4] * 4), "finite"),
        (lambda m: m["frames"][0].update(transform_matrix=[[1e300] * 4] * 4), "transform_matrix"),
        (lambda m: m["frames"][0].update(transform_matrix="no"), "transform_matrix"),
        (lambda m: m["frames"][0].update(transform_matrix=(3 * np.eye(4)).tolist()), "rotation"),
        (lambda m: m["frames"][0].pop("transform_matrix"), "transform_matrix"),
        (lambda m: m["frames"][0].pop("file_path"), "file_path"),
        (lambda m: m["frames"][0].update(camera_model="EQUIRECTANGULAR"), "camera_model"),
        (lambda m: m["frames"][0].update(fl_x="wide"), ""),
        (lambda m: m["frames"][0].update(w="wide"), "wide"),
        (lambda m: m["frames"][0].update(w=float("inf")), ""),
        (lambda m: m["frames"][0].pop("fl_x"), "fl_x"),
        (lambda m: (m["frames"][0].pop("fl_x"), m.update(camera_angle_x="wide")), "camera_angle_x.*wide"),
        (lambda m: m.update(test_filenames=5), "test_filenames"),
        (lambda m: m["frames"][1].update(file_path=m["frames"][0]["file_path"]), ""),
        (lambda m: m.update(frames=[]), "frame"),
        (lambda m: m.pop("frames"), "frames"),
        (lambda m: m.update(ply_file_path="nowhere.ply"), r"nowhere\.ply"),
    ],
)
def test_bad_files(tmp_path: Path, change, word: str) -> None:
    make_nerfstudio(tmp_path, views=3, size=(24, 16), points=20)
    edit(tmp_path / "transforms.json", change)
    with pytest.raises(InputError, match=word or None):
        load(tmp_path)
