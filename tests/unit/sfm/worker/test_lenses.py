"""Lenses with one focal length, without pycolmap."""

import json
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from scene_experts.sfm.worker import lenses


@pytest.mark.parametrize(
    ("cameras", "posed", "errors", "kept"),
    [
        ([1] * 5, (5, 5), (0.31, 0.33), True),
        ([1, 1, 1, 2, 2], (5, 5), (0.31, 0.33), True),  # the other lens stays as it is
        ([1] * 5, (5, 4), (0.31, 0.33), False),  # fewer photographs fit
        ([1] * 5, (5, 5), (0.4, 1.9), False),  # the pixels are no squares
        ([1, 2, 2, 2, 2], (5,), (0.4,), None),  # one photograph says little of its lens
        ([2] * 5, (5,), (0.4,), None),
        ([], (0,), (0.0,), None),
    ],
)
def test_a_lens_with_two_focal_lengths_is_sought_again_with_one(tmp_path, monkeypatch, capsys, cameras, posed, errors, kept):
    """Camera 1 has two focal lengths, camera 2 has two that are nearly one; `cameras` are those of the photographs."""
    asked, updated = [], []
    two = {1: (2109.0, 834.2), 2: (600.0, 610.0)}

    def estimate(colmap, ask):
        i = len(asked)
        asked.append(ask)
        Path(ask["model"]).mkdir(parents=True)
        (Path(ask["model"]) / "cameras.bin").write_text(str(i))
        return {
            "registered": ["a"] * posed[i],
            "lacking": [],
            "mapper": "incremental",
            "mappers": {},
            "error": errors[i],
            "observations": 900.0,
        }

    @contextmanager
    def open_database(path):
        there = [SimpleNamespace(camera_id=i, width=288, height=360, has_prior_focal_length=False) for i in two]
        yield SimpleNamespace(read_all_cameras=lambda: there, update_camera=updated.append)

    def read_model(folder):
        found = {i: SimpleNamespace(model=SimpleNamespace(name="OPENCV"), params=[*two[i], 144.0, 180.0]) for i in two}
        return SimpleNamespace(cameras=found, images={i: SimpleNamespace(camera_id=camera) for i, camera in enumerate(cameras)})

    colmap = SimpleNamespace(Camera=SimpleNamespace, Database=SimpleNamespace(open=open_database), Reconstruction=read_model)
    colmap.ViewGraphCalibrationOptions, colmap.calibrate_view_graph = SimpleNamespace, lambda database, options: True
    monkeypatch.setattr(lenses, "estimate_poses", estimate)
    monkeypatch.setattr(lenses, "measure_angles", lambda model: 5.0)
    (tmp_path / "db").touch()
    names = {"maps": str(tmp_path / "maps"), "model": str(tmp_path / "model"), "database": str(tmp_path / "db")}
    found = lenses.estimate_all(colmap, {**names, "mapper": "auto", "seed": 0, "stretched": 1.1, "narrow": False, "film": False})
    assert len(asked) == len(posed) and (tmp_path / "model" / "cameras.bin").read_text() == ("1" if kept else "0")
    assert found.get("one_focal_length", False) is bool(kept)
    if kept is not None:
        assert asked[1]["mapper"] == "global" and asked[1]["database"] != asked[0]["database"]
        assert [(new.camera_id, new.model, new.params) for new in updated] == [(1, "RADIAL", [834.2, 144.0, 180.0, 0.0, 0.0])]
        assert json.loads(capsys.readouterr().out.splitlines()[-1])["kept"] is kept


@pytest.mark.parametrize(
    ("posed", "errors", "mapper", "angle", "seen", "ran"),
    [
        ((10,), (0.3,), "auto", 4.1, 900.0, [("one", True)]),
        ((9,), (0.3,), "auto", 4.1, 900.0, [("one", True)]),
        ((8, 10), (0.3, 0.3), "auto", 4.1, 900.0, [("one", False), ("two", True)]),  # too few fit
        ((10, 10), (1.3, 1.2), "auto", 4.1, 900.0, [("one", True), ("two", False)]),  # two fit badly, too, and are stretched
        ((10, 10), (1.3, 0.4), "auto", 4.1, 900.0, [("one", False), ("two", True)]),
        ((10, 10), (0.1, 0.1), "auto", 1.6, 900.0, [("one", False), ("two", True)]),  # the camera only turns
        ((10, 10), (0.4, 0.1), "auto", 5.0, 5.0, [("one", False), ("two", True)]),  # the same, with five points
        (
            (10, 10),
            (0.3, 0.3),
            "incremental",
            4.1,
            900.0,
            [("two", False), ("one", True)],
        ),  # that one was asked for: only its lens may change
    ],
)
@pytest.mark.parametrize("film", [False, True])
def test_one_focal_length_first_for_videos_and_without_wide_angles(
    tmp_path, monkeypatch, capsys, posed, errors, mapper, angle, seen, ran, film
):
    asked = []
    monkeypatch.setattr(lenses, "measure_angles", lambda model: angle)

    def estimate(colmap, ask):
        i = len(asked)
        asked.append("one" if ask["database"].endswith(".one") else "two")
        assert ask["mapper"] == ("global" if asked[i] == "one" else mapper)
        Path(ask["model"]).mkdir(parents=True)
        (Path(ask["model"]) / "cameras.bin").write_text(asked[i])
        return {"registered": ["a"] * posed[i], "lacking": [], "mappers": {asked[i]: posed[i]}, "error": errors[i], "observations": seen}

    def read_model(folder):
        lens = SimpleNamespace(model=SimpleNamespace(name="OPENCV"), params=[2109.0, 834.2, 144.0, 180.0])
        return SimpleNamespace(cameras={1: lens}, images={i: SimpleNamespace(camera_id=1) for i in range(10)})

    @contextmanager
    def open_database(path):
        cameras = [SimpleNamespace(camera_id=1, model=SimpleNamespace(name="OPENCV"), params=[432.0, 440.0], width=288, height=360)]
        yield SimpleNamespace(read_all_cameras=lambda: cameras)

    firsts = []
    monkeypatch.setattr(lenses, "estimate_poses", estimate)
    monkeypatch.setattr(lenses, "use_one_focal_length", lambda colmap, database, focal: firsts.append(focal))
    (tmp_path / "db").touch()
    names = {"maps": str(tmp_path / "maps"), "model": str(tmp_path / "model"), "database": str(tmp_path / "db")}
    ask = {**names, "mapper": mapper, "seed": 3, "stretched": 1.1, "narrow": not film, "film": film, "groups": [["a"] * 6, ["b"] * 4]}
    colmap = SimpleNamespace(Database=SimpleNamespace(open=open_database), Reconstruction=read_model)
    colmap.ViewGraphCalibrationOptions, calibrated = SimpleNamespace, []
    colmap.calibrate_view_graph = lambda database, options: calibrated.append((database, options.random_seed))
    found = lenses.estimate_all(colmap, ask)
    assert calibrated == [(names["database"] + ".one", 3)]
    assert asked == [name for name, _ in ran] and firsts == [{1: 432.0 if mapper == "auto" else 834.2}]
    kept = next(name for name, stays in ran if stays)
    assert found.get("one_focal_length", False) is (kept == "one") and (tmp_path / "model" / "cameras.bin").read_text() == kept
    assert ('"one first"' in capsys.readouterr().out) is (mapper == "auto")


def test_the_angles_from_which_the_points_of_a_model_are_seen():
    centres = {1: [0.0, 0.0, 0.0], 2: [1.0, 0.0, 0.0], 3: [0.1, 0.0, 0.0]}
    images = {i: SimpleNamespace(has_pose=True, projection_center=lambda at=at: np.array(at)) for i, at in centres.items()}

    def point(z, *seen):
        return SimpleNamespace(xyz=np.array([0.0, 0.0, z]), track=SimpleNamespace(elements=[SimpleNamespace(image_id=i) for i in seen]))

    points = {5: point(1.0, 1, 2, 3), 7: point(1.0, 1, 3), 9: point(50.0, 1, 2)}  # 45, 5.7 and 1.1 degrees
    model = SimpleNamespace(images=images, points3D=points)
    assert lenses.measure_angles(model) == pytest.approx(np.degrees(np.arctan(0.1)))
    assert lenses.measure_angles(SimpleNamespace(images=images, points3D={})) == 0.0
