"""Views that are cut out of panoramas: their files, masks, rig and poses."""

import importlib.util

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.equirectangular import VIEWS, find_place
from scene_experts.sfm import reconstruct as run
from scene_experts.sfm.options import SfmOptions
from scene_experts.sfm.panoramas import PanoramaRig, choose_held_out, cut_panoramas
from scene_experts.sfm.photos import find_photos
from support.captures import load
from support.messages import naming
from support.rooms import draw_panorama, paint_walls

XMP = b'<x GPano:ProjectionType="equirectangular"/>'


def write_panoramas(folder, count=3, width=128, xmp=True):
    folder.mkdir()
    walls = paint_walls(64)
    for i in range(count):
        picture = Image.fromarray(draw_panorama(walls, (0.2 * i, 0, 0), 0.1 * i, width))
        picture.save(folder / f"{i}.jpg", **({"xmp": XMP} if xmp else {}))
    return folder


def test_views_are_cut_once_and_again_where_a_panorama_changes(tmp_path):
    source, target = write_panoramas(tmp_path / "in"), tmp_path / "work" / "images"
    views, rig = cut_panoramas(find_photos(source), source, target)
    assert len(views) == 36 and rig.side == 40 and rig.params == pytest.approx([20, 20, 20, 20])
    assert {view.camera for view in views} == {(view.folder,) for view in VIEWS} and {find_place(view.name) for view in views} == {
        "0.jpg", "1.jpg", "2.jpg"
    }  # fmt: skip
    first = target / views[0].name
    first.write_bytes(b"kept")
    (target / VIEWS[0].folder / "old.jpg").write_bytes(b"of a panorama that is gone")
    cut_panoramas(find_photos(source), source, target)
    assert first.read_bytes() == b"kept" and not (target / VIEWS[0].folder / "old.jpg").exists()
    cut_panoramas(find_photos(source), source, target, nadir=20)
    with Image.open(first) as picture:
        assert picture.size == (40, 40)


def test_panoramas_that_differ_in_extension_alone_are_named(tmp_path):
    source = write_panoramas(tmp_path / "in")
    with Image.open(source / "1.jpg") as picture:
        picture.save(source / "1.png")
    with pytest.raises(InputError, match=naming("1.jpg", "1.png", "rename")):
        cut_panoramas(find_photos(source), source, tmp_path / "images")


def test_masks_are_cut_like_their_panoramas_and_leave_the_nadir_out(tmp_path):
    source, target = write_panoramas(tmp_path / "in"), tmp_path / "work" / "images"
    left = np.full((64, 128), 255, np.uint8)
    left[:, :64] = 0  # what lies to the left does not count
    Image.fromarray(left).save(source / "1_mask.png")
    views, _ = cut_panoramas(find_photos(source), source, target, nadir=40)
    masks = {view.name: np.array(Image.open(view.mask.path)) for view in views}
    assert len(masks) == 36
    right, leftward = masks["yaw090_pitch+35/1.jpg"], masks["yaw270_pitch+35/1.jpg"]
    assert (right == 255).all() and (leftward == 0).all()
    below = masks["yaw000_pitch-35/0.jpg"]
    assert below[20, 20] == 255 and below[-1, 20] == 0
    without, _ = cut_panoramas(find_photos(source), source, target)
    assert {view.name for view in without if view.mask} == {view.name for view in views if view.name.endswith("/1.jpg")}


def test_an_upside_down_panorama_is_turned_by_its_exif(tmp_path):
    source = write_panoramas(tmp_path / "in")
    upright, _ = cut_panoramas(find_photos(source), source, tmp_path / "upright")
    with Image.open(source / "1.jpg") as picture:
        turned, exif = picture.transpose(Image.Transpose.ROTATE_180), picture.getexif()
    exif[0x0112] = 3
    turned.save(source / "1.jpg", quality=100, subsampling=0, exif=exif)
    cut_panoramas(find_photos(source), source, tmp_path / "turned")
    for view in upright:
        a, b = (np.asarray(Image.open(tmp_path / folder / view.name), dtype=float) for folder in ("upright", "turned"))
        assert np.abs(a - b).mean() < 2
    with Image.open(tmp_path / "turned" / upright[0].name) as picture:
        assert 0x0112 not in picture.getexif()


def test_other_photographs_are_their_own_place():
    assert find_place("a/b.jpg") == "a/b.jpg" and find_place("yaw045_pitch+00/a/b.jpg") == "a/b.jpg"


def test_whole_panoramas_are_held_out():
    names = [f"{view.folder}/{i}.jpg" for view in VIEWS for i in range(10)] + ["0.jpg", "8.jpg"]
    held = choose_held_out(names)
    assert len(held) == 2 * len(VIEWS) and {find_place(name) for name in held} == {"0.jpg", "8.jpg"} and "0.jpg" not in held


def test_the_worker_is_told_each_turn():
    told = PanoramaRig(40).plain()
    assert len(told["views"]) == 12 and np.allclose(told["views"]["yaw045_pitch+00"], VIEWS[0].rig_from_view.T)


@pytest.mark.slow
@pytest.mark.foreign
def test_poses_of_panoramas_are_those_they_were_drawn_from(tmp_path):
    if importlib.util.find_spec("pycolmap") is None:
        pytest.skip("pycolmap is not installed")
    source, walls = tmp_path / "photos", paint_walls(1024)
    source.mkdir()
    places = np.array([[0, 0, 0], [0.5, 0.1, 0.3], [1.0, -0.1, 0.1], [0.8, 0, -0.5]])
    for i, place in enumerate(places):
        Image.fromarray(draw_panorama(walls, place, 0.2 * i, 1024)).save(source / f"{i}.jpg", quality=95, xmp=XMP)
    said = []
    note = run.reconstruct(source, tmp_path / "capture", SfmOptions(threads=2), say=said.append)
    assert note["with_pose"] == 48 and "4 of 4 photographs are 360 degree panoramas" in said[0]
    capture = load(tmp_path / "capture")
    assert {find_place(capture.views[i].name) for i in capture.test} == {"0.jpg"} and len(capture.test) == 12
    found: dict[str, list] = {}
    for view in capture.views:
        found.setdefault(find_place(view.name), []).append(view.camera.position.numpy())
    assert max(np.ptp(np.array(group), axis=0).max() for group in found.values()) < 1e-4  # one place each
    centres = np.array([np.mean(found[f"{i}.jpg"], axis=0) for i in range(4)])
    apart = lambda points: np.linalg.norm(points[:, None] - points[None], axis=-1)  # noqa: E731
    scale = apart(places)[0, 1] / apart(centres)[0, 1]
    assert np.allclose(scale * apart(centres), apart(places), atol=0.02)
