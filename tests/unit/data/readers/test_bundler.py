"""Reconstructions of Bundler, against the formulas of its manual."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.data.readers.bundler import READER
from scene_experts.data.readers.reader import ReadOptions
from support.captures import load
from support.foreign_poses import make_bundler
from support.messages import naming


def test_pixels_are_those_of_the_manual(tmp_path: Path) -> None:
    """P = R X + t, p = -P / P.z, p' = f r(p) p, from the middle of the picture, y up."""
    made = make_bundler(tmp_path)
    words = [list(map(float, line.split())) for line in (tmp_path / "bundle.out").read_text().splitlines()[2:7]]
    (f, k1, k2), R, t = words[0], np.array(words[1:4]), np.array(words[4])
    image = READER.read(tmp_path, ReadOptions()).images[0]
    lens = image.lens
    assert lens is not None and (lens.width, lens.height) == (48, 32)
    for X in made.model.xyz[:10]:
        P = R @ X + t
        p = -P[:2] / P[2]
        norm2 = float(p @ p)
        x, y = f * (1 + k1 * norm2 + k2 * norm2**2) * p
        ours = image.world_to_cam[:3, :3] @ X + image.world_to_cam[:3, 3]
        u, v = lens.distort(*(ours[:2, None] / ours[2]))
        assert (float(u[0]) * lens.fx + lens.cx, float(v[0]) * lens.fy + lens.cy) == pytest.approx((24 + x, 16 - y), abs=1e-9)


def test_photographs_without_a_pose_are_left_out(tmp_path: Path) -> None:
    make_bundler(tmp_path)
    lines = (tmp_path / "bundle.out").read_text().splitlines()
    lines[7:12] = ["0 0 0"] * 5
    (tmp_path / "bundle.out").write_text("\n".join(lines))
    capture = load(tmp_path)
    assert [view.name for view in capture.views] == ["view_000.png", "view_002.png", "view_003.png"]
    assert any("1 of 4 photographs have no pose" in w for w in capture.warnings)


@pytest.mark.parametrize(
    ("file", "names"), [("bundle.rd.out", "list.rd.txt"), ("bundle/bundle.out", "list.txt"), ("a.out", "a.out.list.txt")]
)
def test_other_places_and_names_with_blanks(tmp_path: Path, file: str, names: str) -> None:
    made = make_bundler(tmp_path)
    (tmp_path / "images/view_001.png").rename(tmp_path / "images/view 1 of 2.png")
    text = (tmp_path / "list.txt").read_text().replace("images/view_001.png 0 50.5", "./view 1 of 2.png")
    (tmp_path / "list.txt").unlink()
    (tmp_path / names).write_bytes(text.replace("\n", "\r\n").encode())
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / "bundle.out").rename(tmp_path / file)
    capture = load(tmp_path, normalise="none")
    assert capture.kind == "bundler" and len(capture.views) == 4
    view = next(view for view in capture.views if view.name == "view 1 of 2.png")
    np.testing.assert_allclose(view.camera.world_to_cam, made.model.images[1].world_to_cam(), atol=1e-6)


def test_smaller_photographs_keep_the_field_of_view(tmp_path: Path) -> None:
    """f is in pixels of the photographs in images, whatever folder is read."""
    made = make_bundler(tmp_path)
    (tmp_path / "images_2").mkdir()
    for path in (tmp_path / "images").iterdir():
        Image.open(path).resize((24, 16)).save(tmp_path / "images_2" / path.name)
    source = load(tmp_path, images="images_2").images.sources[0]
    assert (source.lens.width, source.lens.fx) == (24, pytest.approx(made.model.cameras[1].fx / 2))
    shutil.rmtree(tmp_path / "images")
    assert any("pixels of the aligned photographs" in w for w in load(tmp_path, images="images_2").warnings)


def test_files_that_do_not_fit(tmp_path: Path) -> None:
    make_bundler(tmp_path)
    path, whole = tmp_path / "bundle.out", (tmp_path / "bundle.out").read_text()
    for text, facts in (
        (whole[:200], ["bundle.out"]),
        (whole.replace("4 40", "4000000000000 40", 1), ["bundle.out"]),
        (whole.replace("4 40", "4 9000", 1), ["bundle.out"]),
        (whole.replace("4 40", "4 -1", 1), ["bundle.out"]),
        (whole.replace("2 0 5 1.5", "2000000000000 0 5 1.5", 1), ["bundle.out", "views"]),
        (whole.replace("2 0 5 1.5", "-2 0 5 1.5", 1), ["bundle.out", "views"]),
        (whole.replace(" 0.01 ", " nan ", 1), ["bundle.out"]),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=naming(*facts)):
            load(tmp_path)
    path.write_text(whole)
    names = (tmp_path / "list.txt").read_text()
    (tmp_path / "list.txt").write_text(names + names)
    with pytest.raises(InputError, match=naming("4 names", "8")):
        load(tmp_path)
    (tmp_path / "list.txt").unlink()
    with pytest.raises(InputError, match=naming("list.txt", "bundle.out")):
        load(tmp_path)
