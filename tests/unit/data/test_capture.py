"""Loading whole captures: detection, normalisation, resizing, and every kind of unusable input."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.capture import name_capture
from scene_experts.data.equirectangular import VIEWS
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import read_model, write_model
from scene_experts.data.summary import neighbour_distance, summarise
from support.captures import load
from support.lenses import LENSES
from support.messages import naming
from support.synthetic import Synthetic, make_capture, picture


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("made"), views=10, size=(48, 32), points=300)


@pytest.fixture
def copy(made: Synthetic, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made.folder, tmp_path / "copy"))


def test_the_parts_of_a_capture(made: Synthetic) -> None:
    capture = load(made.folder)
    assert capture.kind == "colmap" and capture.name == made.folder.name and capture.split == "mod8" and capture.resolution == "cap1600"
    assert [v.name for v in capture.views] == sorted(made.images) and [v.camera.id for v in capture.views] == list(range(10))
    assert capture.test == (0, 8) and capture.extent == 5.0
    for view in capture.views:
        frame = capture.frame(view.camera.id)
        np.testing.assert_array_equal(frame.rgb, made.images[view.name])
        assert frame.mask is None and frame.rgb.shape[:2] == (view.camera.height, view.camera.width)
        assert view.camera.world_to_cam.dtype == torch.float32 and view.camera.near == pytest.approx(0.1)
    assert capture.points is not None and capture.points.xyz.dtype == torch.float64
    np.testing.assert_allclose(capture.world.to_input(capture.points.xyz), made.model.xyz, atol=1e-12)
    np.testing.assert_array_equal(capture.points.rgb, made.model.rgb)


def test_principal_points_are_used_or_centred_on_request(made: Synthetic) -> None:
    camera = load(made.folder).views[0].camera
    assert abs(camera.cx - camera.width / 2) > 4 and abs(camera.cy - camera.height / 2) > 2
    parity = load(made.folder, ignore_principal_point=True).views[0].camera
    assert (parity.cx, parity.cy) == (24.0, 16.0) and parity.fx == camera.fx


@pytest.mark.parametrize("factor", [100.0, 0.01])
def test_the_unit_of_a_capture_does_not_matter(made: Synthetic, tmp_path: Path, factor: float) -> None:
    make_capture(tmp_path, views=10, size=(48, 32), points=300, scale=factor)
    a, b = load(made.folder), load(tmp_path)
    assert b.world.scale * factor == pytest.approx(a.world.scale, rel=1e-9)
    for v, w in zip(a.views, b.views):
        torch.testing.assert_close(v.camera.world_to_cam, w.camera.world_to_cam, atol=1e-6, rtol=1e-6)
        assert v.camera.near == w.camera.near
    assert a.points is not None and b.points is not None
    torch.testing.assert_close(a.points.xyz, b.points.xyz, atol=1e-9, rtol=1e-9)
    assert a.extent == b.extent


def test_large_coordinates_lose_no_precision(made: Synthetic, copy: Path) -> None:
    model = read_model(copy / "sparse/0")  # as in surveyed data: half a million units from the origin
    away = np.array([5e5, 4.2e6, 100.0])
    images = tuple(
        replace(i, translation=tuple(np.array(i.translation) - i.world_to_cam()[:3, :3] @ away))  # type: ignore[arg-type]
        for i in model.images
    )
    write_model(copy / "sparse/0", replace(model, images=images, xyz=model.xyz + away))
    a, b = load(made.folder), load(copy)
    for v, w in zip(a.views, b.views):
        torch.testing.assert_close(v.camera.world_to_cam, w.camera.world_to_cam, atol=1e-5, rtol=1e-5)


def test_distorted_captures_are_undistorted_to_the_pinhole_picture(tmp_path: Path) -> None:
    made = make_capture(tmp_path, views=3, size=(96, 64), points=50, distortion=LENSES[4])
    capture = load(tmp_path, split="none", normalise="none", resolution="as-is")
    for view in capture.views:
        camera = view.camera
        flat = Lens("PINHOLE", camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy))
        truth = made.picture(flat, camera.world_to_cam.double().numpy())
        error = np.abs(capture.frame(camera.id).rgb.numpy() / 255 - truth)
        assert np.median(error) < 0.006 and error.mean() < 0.03


def test_resizing_while_loading_gives_the_smaller_pinhole_picture(made: Synthetic) -> None:
    capture = load(made.folder, resolution="factor:2", normalise="none")
    camera = capture.views[1].camera
    lens = Lens("PINHOLE", camera.width, camera.height, (camera.fx, camera.fy, camera.cx, camera.cy))
    truth = picture(lens, camera.world_to_cam.double().numpy(), 1.0, (0, 0, 0), 8)
    assert np.abs(capture.frame(1).rgb.numpy() / 255 - truth).mean() < 0.02


def test_image_folders_of_another_size(made: Synthetic, copy: Path) -> None:
    (copy / "images_2").mkdir()
    for path in (copy / "images").iterdir():
        image = Image.open(path)
        image.resize((image.width // 2, image.height // 2)).save(copy / "images_2" / f"{path.stem}.jpg")
    full = load(copy)
    for half in (load(copy, images="images_2"), load(copy, resolution="inria:2")):
        assert (half.views[0].camera.width, half.views[0].camera.height) == (24, 16)
        torch.testing.assert_close(half.views[0].camera.K[:2], full.views[0].camera.K[:2] / 2)
        assert any("another extension" in w for w in half.warnings)
    assert load(copy, resolution="inria:2").resolution == "inria:2"
    with pytest.raises(InputError, match=naming("images_4", "images_2", "--resolution")):
        load(copy, resolution="inria:4")


def test_images_rotated_by_exif_follow_the_camera(copy: Path) -> None:
    """The tool applied the orientation: the camera is 48x32, the stored pixels are 32x48 with a quarter turn in EXIF."""
    path = copy / "images/view_000.png"
    upright = np.asarray(Image.open(path))
    exif = Image.Exif()
    exif[0x0112] = 6  # shown after a quarter turn clockwise
    Image.fromarray(np.ascontiguousarray(np.rot90(upright))).save(path, exif=exif)
    np.testing.assert_array_equal(load(copy).frame(0).rgb, upright)


def test_masks_and_alpha(made: Synthetic, copy: Path) -> None:
    (copy / "masks").mkdir()
    stencil = np.full(made.images["view_000.png"].shape[:2], 255, np.uint8)
    stencil[:10] = 0
    Image.fromarray(stencil).save(copy / "masks/view_000.png.png")
    rgba = np.dstack((made.images["view_001.png"], np.full(made.images["view_001.png"].shape[:2], 51, np.uint8)))
    Image.fromarray(rgba).save(copy / "images/view_001.png")
    capture = load(copy)
    mask = capture.frame(0).mask
    assert mask is not None and mask.dtype == torch.float32 and mask[:10].max() == 0 and mask[10:].min() == 1
    mask = capture.frame(1).mask
    assert mask is not None and torch.allclose(mask, torch.tensor(0.2))
    assert capture.frame(2).mask is None and summarise(capture)["masks"] == 1


def test_the_summary_is_json_and_true(made: Synthetic) -> None:
    capture = load(made.folder)
    said = json.loads(json.dumps(summarise(capture)))
    assert (said["views"], said["train"], said["test"], said["points"], said["kind"]) == (10, 8, 2, 300, "colmap")
    assert said["sizes"] == {"48x32": 4, "40x36": 3, "32x48": 3} and said["camera_models"] == {"PINHOLE": 10}
    assert capture.points is not None
    d = torch.cdist(capture.points.xyz, capture.points.xyz).fill_diagonal_(9e9).amin(1).median()
    assert said["median_neighbour_distance"] == pytest.approx(float(d), rel=1e-6)
    assert any("2" in w and "held-out" in w for w in said["warnings"]) and any("3" in w and "size" in w for w in said["warnings"])


def test_neighbour_distances_of_many_points_are_sampled() -> None:
    xyz = torch.rand((4000, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert neighbour_distance(xyz, exact=1000) == pytest.approx(neighbour_distance(xyz), rel=0.1)


def test_fewer_views(made: Synthetic) -> None:
    capture = load(made.folder, max_views=4)
    assert [v.name for v in capture.views] == [f"view_{i:03d}.png" for i in (0, 2, 5, 7)] and capture.test == (0,)


def test_photographs_left_out_by_name_are_in_no_part(made: Synthetic, copy: Path) -> None:
    whole = load(made.folder)
    (copy / "images" / "view_003.png").write_bytes(b"no picture")  # it need not even be readable
    capture = load(copy, leave_out=("view_003", "images/view_000.png"))
    left = [name for name in sorted(made.images) if name not in ("view_000.png", "view_003.png")]
    assert [view.name for view in capture.views] == left and capture.omitted == ("view_000.png", "view_003.png")
    assert sorted(capture.train + capture.test) == list(range(8)) and capture.test == (0,)  # the split is that of the others
    assert capture.views[0].name == "view_001.png" and capture.fingerprint() != whole.fingerprint()
    with pytest.raises(InputError, match=naming("--leave-out", "view_01", "view_001")):
        load(made.folder, leave_out=("view_01",))
    with pytest.raises(InputError, match=naming("DSC_0423.JPG", "view_000.png, view_001.png, view_002.png and 7 more")):
        load(made.folder, leave_out=("DSC_0423.JPG",))
    with pytest.raises(InputError, match=naming("--leave-out", "none")):
        load(made.folder, leave_out=tuple(made.images))


def test_a_name_of_two_photographs_is_refused(copy: Path) -> None:
    model = read_model(copy / "sparse" / "0")
    first, second, *others = model.images
    for folder, image in (("a", first), ("b", second)):
        (copy / "images" / folder).mkdir()
        shutil.move(copy / "images" / image.name, copy / "images" / folder / "one.png")
    images = (replace(first, name="a/one.png"), replace(second, name="b/one.png"), *others)
    write_model(copy / "sparse" / "0", replace(model, images=images))
    assert load(copy, leave_out=("b/one",)).omitted == ("b/one.png",)
    with pytest.raises(InputError, match=naming("a/one.png, b/one.png", "folder")):
        load(copy, leave_out=("one",))


def test_the_views_of_a_panorama_are_left_out_together(copy: Path) -> None:
    model = read_model(copy / "sparse" / "0")
    first, second, *others = model.images
    names = [f"{view.folder}/pano.png" for view in VIEWS[:2]]
    for name, image in zip(names, (first, second)):
        (copy / "images" / name).parent.mkdir()
        shutil.move(copy / "images" / image.name, copy / "images" / name)
    write_model(copy / "sparse" / "0", replace(model, images=(*(replace(i, name=n) for i, n in zip((first, second), names)), *others)))
    assert load(copy, leave_out=("pano.png",)).omitted == tuple(sorted(names))
    assert load(copy, leave_out=(names[0],)).omitted == (names[0],)


def test_images_of_another_shape(copy: Path) -> None:
    Image.new("RGB", (48, 48)).save(copy / "images/view_000.png")
    with pytest.raises(InputError, match=r"view_000\.png.*48x32"):
        load(copy)


def test_no_points(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(copy / "sparse/0", replace(model, ids=model.ids[:0], xyz=model.xyz[:0], rgb=model.rgb[:0], error=model.error[:0]))
    with pytest.raises(InputError, match="--init random"):
        load(copy)
    (copy / "sparse/0/points3D.bin").unlink()
    with pytest.raises(InputError, match=r"points3D\.bin.*--init random"):
        load(copy)
    with pytest.raises(InputError, match=r"points3D\.bin.*--init random"):
        load(copy, init="dense")
    looked = load(copy, allow_no_points=True)
    assert looked.points is None and any("--init random" in w for w in looked.warnings)
    capture = load(copy, init="random")
    assert capture.points is not None and len(capture.points.xyz) > 1000


def test_only_points_that_are_not_finite(copy: Path) -> None:
    model = read_model(copy / "sparse/0")
    write_model(copy / "sparse/0", replace(model, xyz=np.full_like(model.xyz, np.nan)))
    with pytest.raises(InputError, match="--init random"):
        load(copy)


def test_paths_without_a_capture(made: Synthetic, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=naming(tmp_path)):
        load(tmp_path / "none")
    with pytest.raises(InputError, match=naming("view_000.png")):
        load(made.folder / "images/view_000.png")
    with pytest.raises(InputError, match=naming(tmp_path, "sparse/0", "transforms_train.json")):
        load(tmp_path)
    shutil.copytree(made.folder / "images", tmp_path / "images")
    with pytest.raises(InputError, match=naming(10, "scene-experts capture")):
        load(tmp_path)
    with pytest.raises(InputError, match=naming(10, "images --out CAPTURE")):
        load(tmp_path / "images")
    with pytest.raises(InputError, match=naming(made.folder)):
        load(made.folder / "sparse/0")
    for part in ("images", "sparse"):
        with pytest.raises(InputError, match=naming(made.folder)):
            load(made.folder / part)


def test_few_photographs_are_all_trained_on(made: Synthetic, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("scene_experts.data.prepare.FEW", 12)
    capture = load(made.folder)
    assert len(capture.train) == 10 and not capture.test and capture.split == "none"
    assert any("all of 10 photographs are trained on" in line and "--split" in line for line in capture.warnings)
    assert load(made.folder, split="mod8").test == (0, 8)
    monkeypatch.setattr("scene_experts.data.prepare.FEW", 10)
    assert load(made.folder).test == (0, 8)


def test_the_capture_of_make_is_called_like_the_folder_above_it(tmp_path: Path) -> None:
    assert name_capture(tmp_path / "statue-scene" / "capture") == "statue-scene"
    assert name_capture(tmp_path / "statue") == "statue"
