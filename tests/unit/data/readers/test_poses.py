"""What the readers of files of poses share."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.readers import poses
from scene_experts.data.readers.reader import ReadOptions
from support.captures import load
from support.foreign_poses import make_bundler, make_metashape, make_polycam, make_realitycapture
from support.messages import naming
from support.synthetic import Synthetic

MAKERS = {"realitycapture": make_realitycapture, "metashape": make_metashape, "bundler": make_bundler, "polycam": make_polycam}
Make = Callable[..., Synthetic]


@pytest.mark.parametrize("kind", list(MAKERS))
def test_every_program_gives_the_same_scene(tmp_path: Path, kind: str) -> None:
    made = MAKERS[kind](tmp_path, views=5)
    capture = load(tmp_path, normalise="none")
    assert capture.kind == kind and [view.name.rpartition("/")[2] for view in capture.views] == sorted(made.images)
    for view, image in zip(capture.views, made.model.images):
        np.testing.assert_allclose(view.camera.world_to_cam, image.world_to_cam(), atol=1e-6)
    assert capture.points is not None
    np.testing.assert_allclose(capture.points.xyz, made.model.xyz, atol=1e-6)
    np.testing.assert_array_equal(capture.points.rgb, made.model.rgb)
    assert not any("frame" in w for w in capture.warnings)


@pytest.mark.parametrize("kind", ["realitycapture", "metashape", "polycam"])
def test_without_points_training_starts_from_random_ones(tmp_path: Path, kind: str) -> None:
    MAKERS[kind](tmp_path)
    (tmp_path / "cloud.ply").rename(tmp_path / "mine.points")
    capture = load(tmp_path)
    assert capture.points is not None and len(capture.points.xyz) == 10_000
    assert any("--points" in w for w in capture.warnings) and any("random points" in w for w in capture.warnings)
    (tmp_path / "mine.points").rename(tmp_path / "mine.PLY.ply")
    points = load(tmp_path).points
    assert points is not None and len(points.xyz) == 40


@pytest.mark.parametrize("kind", ["realitycapture", "metashape", "bundler"])
def test_photographs_beside_the_poses_absent_ones_and_masks(tmp_path: Path, kind: str) -> None:
    MAKERS[kind](tmp_path)
    for path in (tmp_path / "images").iterdir():
        shutil.move(path, tmp_path)
    (tmp_path / "images").rmdir()
    (tmp_path / "masks").mkdir()
    shutil.copy(tmp_path / "view_001.png", tmp_path / "masks")
    assert [source.mask is not None for source in load(tmp_path).images.sources] == [False, True, False, False]
    (tmp_path / "view_002.png").unlink()
    with pytest.raises(InputError, match=naming("view_002", "--missing drop")):
        load(tmp_path)
    assert len(load(tmp_path, missing="drop").views) == 3


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("kind", ["realitycapture", "metashape", "bundler"])
def test_byte_order_marks(tmp_path: Path, kind: str, encoding: str) -> None:
    MAKERS[kind](tmp_path)
    for path in tmp_path.iterdir():
        if path.suffix in (".csv", ".xml", ".out", ".txt"):
            path.write_bytes(path.read_text().replace('encoding="UTF-8"', "").encode(encoding))
    assert load(tmp_path).kind == kind


def test_several_files_of_poses(tmp_path: Path) -> None:
    make_realitycapture(tmp_path)
    lines = (tmp_path / "cameras.csv").read_text().splitlines()
    (tmp_path / "few.csv").write_text("\n".join(lines[:3]))
    (tmp_path / "notes.csv").write_text("a,b,c\n")
    capture = load(tmp_path)
    assert len(capture.views) == 4 and any("few.csv" in w and "--model" in w for w in capture.warnings)
    assert len(load(tmp_path, model="few.csv", split="none").views) == 1
    other = tmp_path / "other"
    make_metashape(other)
    shutil.copy(other / "cameras.xml", tmp_path)
    assert any("--model" in w and "Metashape" in w for w in load(tmp_path).warnings)
    assert load(tmp_path, model="cameras.xml").kind == "metashape"
    for wrong in ("absent.csv", "notes.txt"):
        (tmp_path / "notes.txt").write_text("")
        with pytest.raises(InputError, match=naming("--model", wrong)):
            load(tmp_path, model=wrong)


@pytest.mark.parametrize("kind", ["realitycapture", "metashape"])
def test_a_photograph_listed_twice(tmp_path: Path, kind: str) -> None:
    MAKERS[kind](tmp_path)
    path = next(p for p in tmp_path.iterdir() if p.suffix in (".csv", ".xml"))
    path.write_text(path.read_text().replace("view_001", "view_000"))
    with pytest.raises(InputError, match=r"view_000.*twice"):
        load(tmp_path)


def test_no_poses_and_matrices_that_are_no_rotations(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="at least one pose"):
        poses.assemble(tmp_path, tmp_path / "a.csv", [], ReadOptions(), [])
    for bad in (2 * np.eye(3), -np.eye(3), np.full((3, 3), np.nan), np.zeros((3, 3))):
        with pytest.raises(InputError, match="camera 7"):
            poses.nearest_rotation(bad, "camera 7", tmp_path)
    turned = poses.nearest_rotation(np.eye(3) + 1e-4, "camera 7", tmp_path)
    assert torch.allclose(torch.from_numpy(turned @ turned.T), torch.eye(3, dtype=torch.float64))
    for words in (["1", "2"], ["1", "x", "3"], ["1", "nan", "3"], ["1", "1e30", "3"]):
        with pytest.raises(InputError, match="3 numbers as a row"):
            poses.to_numbers(words, 3, "a row", tmp_path)
