"""Runs: drawn, scored, exported, found again."""

import copy
import json
import pickle
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import scene_experts as se
from scene_experts.core.errors import InputError
from scene_experts.evaluate.pictures import to_8bit
from support.messages import naming
from support.synthetic import make_capture
from support.tracks import add_tracks


def test_a_picture_is_the_one_that_eval_draws(run, capture):
    scores = run.evaluate(lpips=False)
    for camera in run.test_cameras:
        picture = run.render(camera)
        assert picture.dtype == np.float32 and picture.shape == (camera.height, camera.width, 3)
        assert picture.min() >= 0 and picture.max() <= 1
        name = capture.names[camera.view]
        assert np.array_equal(to_8bit(torch.from_numpy(picture)), np.asarray(Image.open(run.path / "test" / "renders" / name)))
    assert scores.psnr == pytest.approx(np.mean([view["psnr"] for view in scores.per_view.values()])) and 0 < scores.ssim <= 1
    assert scores.lpips is None and scores.details["step"] == 6 and (run.path / "results.json").is_file()
    assert run.report() == run.path / "report.html" and (run.path / "report.html").is_file()


def test_layers_are_in_the_units_of_the_capture(run, capture):
    camera = capture.look_at(capture.centre + 9 * capture.up)
    layers = run.render_layers(camera)
    shape = (camera.height, camera.width)
    assert layers.image.shape == (*shape, 3) and layers.depth.shape == layers.alpha.shape == shape
    assert np.array_equal(layers.image, run.render(camera)) and layers.alpha.max() <= 1 and layers.depth.dtype == np.float32
    dense = layers.alpha > 0.9
    assert dense.any() and 4 < np.median(layers.depth[dense]) < 12, "the scene is about 9 below the camera, in the capture's unit"
    assert (layers.depth[layers.alpha == 0] == 0).all()


def test_false_colours(run, capture):
    camera = run.test_cameras[0]
    pictures = {show: run.render(camera, show) for show in ("depth", "alpha", "experts", "entropy", "activation")}
    assert all(picture.shape == (camera.height, camera.width, 3) for picture in pictures.values())
    with pytest.raises(se.InputError, match="show"):
        run.render(camera, "normals")
    with pytest.raises(se.InputError):
        run.render(se.Camera(camera.world_to_camera, camera.K, 8, 8, view=99))


def test_a_run_opens_from_any_folder(run, capture, tmp_path, monkeypatch):
    picture = run.render(run.test_cameras[0])
    monkeypatch.chdir(tmp_path)
    opened = se.open_run(run.path)
    assert np.array_equal(opened.render(opened.test_cameras[0]), picture)
    assert (opened.step, opened.recipe, opened.path) == (run.step, run.recipe, run.path) and opened.seconds > 0
    monkeypatch.chdir(capture.path.parent)
    relative = se.train(run.recipe, capture.path.name, tmp_path / "relative", stop_at=1, progress=False)
    monkeypatch.chdir(tmp_path)
    assert len(se.open_run(relative.path or "").test_cameras) == 2, "trained with a relative path, opened from another folder"
    assert len(opened.train_cameras) == 7 and "step 6" in repr(opened) and opened.scene.table is not None


def test_a_run_stays_in_its_folder(run, capture, tmp_path, monkeypatch):
    """A working folder with another run of the same relative name is left alone."""
    for place in ("here", "there"):
        shutil.copytree(run.path, tmp_path / place / "runs" / "a")
        (tmp_path / place / "runs" / "a" / "results.json").unlink(missing_ok=True)
    monkeypatch.chdir(tmp_path / "here")
    opened = se.open_run("runs/a", data=capture.loaded.root)
    monkeypatch.chdir(tmp_path / "there")
    opened.evaluate(lpips=False)
    assert (tmp_path / "here" / "runs" / "a" / "results.json").is_file() and not Path("runs/a/results.json").exists()


def test_a_folder_that_is_gone_is_not_made_again(run, capture, tmp_path):
    shutil.copytree(run.path, tmp_path / "run")
    opened = se.open_run(tmp_path / "run", data=capture.loaded.root)
    shutil.rmtree(tmp_path / "run")
    for call in (lambda: opened.evaluate(lpips=False), lambda: opened.export("compact"), opened.report):
        with pytest.raises(InputError, match=naming(str(tmp_path / "run"), "removed")):
            call()
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("copies", [pickle.dumps, copy.deepcopy])
def test_other_processes_open_a_run_themselves(run, capture, small, copies):
    for value, said in ((run, f"open_run({str(run.path)!r})"), (capture, f"load_capture({str(capture.loaded.root)!r})")):
        with pytest.raises(InputError, match=naming(said)):
            copies(value)
    with pytest.raises(InputError, match=naming("save(FOLDER)")):
        copies(se.train(small, capture, progress=False))


def test_a_capture_that_moved_is_named(run, capture, small, tmp_path):
    moved = tmp_path / "moved"
    shutil.copytree(capture.path, tmp_path / "first")
    path = se.train(small, tmp_path / "first", tmp_path / "run", progress=False, stop_at=1).path
    (tmp_path / "first").rename(moved)
    opened = se.open_run(path)
    with pytest.raises(se.InputError, match="first"):
        _ = opened.capture
    assert se.open_run(path, data=moved).capture.path == moved


def test_a_checkpoint_may_be_chosen(capture, small, tmp_path):
    path = se.train(small, capture, tmp_path, save_every=3, progress=False).path
    assert se.open_run(path, step=3).step == 3
    with pytest.raises(se.InputError, match=naming(5)):
        se.open_run(path, step=5)
    with pytest.raises(se.InputError, match="absent"):
        se.open_run(tmp_path / "absent")


def test_words_that_mean_nothing_are_named(run, tmp_path):
    before = {path: path.stat().st_mtime_ns for path in run.path.rglob("*")}
    for words in ({"views": "val"}, {"appearance": "fit"}):
        with pytest.raises(se.InputError, match=naming(*words, *words.values())):
            run.evaluate(**words, lpips=False)
    for words in ({"frame": "world"}, {"floaters": "drop"}):
        with pytest.raises(se.InputError, match=naming(*words, *words.values())):
            run.export("ply", tmp_path / "scene.ply", **words)
    for number in ({"sh_degree": 1.5}, {"cells": 1}, {"max_gaussians": 10.5}, {"refine": "5"}, {"quality": "0.1"}):
        with pytest.raises(se.InputError, match=naming(*number)):
            run.export("ply", tmp_path / "scene.ply", **number)
    with pytest.raises(InputError, match=naming("attribute", "colour")):
        run.render(run.test_cameras[0], attribute="colour")
    with pytest.raises(InputError, match=naming("a single one")):
        run.write_video(tmp_path / "flight.mp4", run.test_cameras[0])
    with pytest.raises(InputError, match=naming("fps", "'24'")):
        run.write_video(tmp_path / "flight.mp4", run.test_cameras, fps="24")
    assert before == {path: path.stat().st_mtime_ns for path in run.path.rglob("*")} and not list(tmp_path.iterdir())


def test_files_come_back(run, capture, tmp_path):
    compact = run.export("compact", tmp_path / "scene.compact")
    anchors = run.export("anchors", tmp_path / "anchors")
    baked = run.export("ply", tmp_path / "scene.ply", sh_degree=1, refine=0)
    assert compact.stat().st_size < 300_000 and anchors.is_dir() and baked.is_file()
    camera = capture.test_cameras[0]
    for source in (compact, tmp_path / "anchors", baked):
        again = se.import_run(source, capture, tmp_path / f"from_{source.name}")
        assert np.abs(again.render(camera) - run.render(camera)).mean() < 0.1
    with pytest.raises(se.InputError, match="obj"):
        run.export("obj")
    with pytest.raises(se.InputError):
        se.import_run(tmp_path / "absent", capture, tmp_path / "nothing")


def test_frames_go_to_pictures_or_a_video(run, capture, tmp_path):
    cameras = capture.camera_path("orbit", frames=3, size=(16, 16))
    folder = run.write_video(tmp_path / "frames", cameras)
    assert sorted(path.name for path in folder.glob("*.png")) == ["00000.png", "00001.png", "00002.png"]
    first = np.asarray(Image.open(folder / "00000.png"))
    assert np.array_equal(first, to_8bit(torch.from_numpy(run.render(cameras[0]))))
    pytest.importorskip("imageio_ffmpeg")
    assert run.write_video(tmp_path / "orbit.mp4", (camera for camera in cameras), fps=3).stat().st_size > 500
    with pytest.raises(se.InputError):
        run.write_video(tmp_path / "sizes.mp4", [cameras[0], cameras[1].resized(20, 20)])
    for out, some, fps in (("a.mp4", [], 24.0), ("a.mp4", cameras, 0.0), ("a.txt", cameras, 24.0)):
        with pytest.raises(se.InputError):
            run.write_video(tmp_path / out, some, fps=fps)


def test_a_run_with_refined_poses_has_its_own_cameras(tmp_path):
    folder = make_capture(tmp_path / "c", views=12, mixed_sizes=False).folder
    add_tracks(folder, turned=0.03, shifted=0.05)
    recipe = se.recipe("scaffold-gs", iterations=30, refine_poses=True)
    quiet = {"progress": False, "preview_every": 0, "device": "cpu"}
    run = se.train(recipe, se.load_capture(folder, split="mod8"), tmp_path / "run", **quiet)
    again, memory = se.open_run(tmp_path / "run"), se.train(recipe, se.load_capture(folder, split="mod8"), **quiet)
    saved = memory.save(tmp_path / "saved")
    raw = se.load_capture(folder, split="mod8").train_cameras
    given = np.stack([camera.position for camera in raw])
    for one in (run, again, memory, saved):
        found = np.stack([camera.position for camera in one.train_cameras])
        assert np.abs(found - given).max() > 0.01
        np.testing.assert_allclose(found, np.stack([camera.position for camera in again.train_cameras]), atol=1e-4)
    scores = [one.evaluate("train", lpips=False).psnr for one in (run, again)]
    assert scores[0] == scores[1]
    for name in ("run", "saved"):
        written = {c["img_name"]: c["position"] for c in json.loads((tmp_path / name / "cameras.json").read_text())}
        told = np.stack([written[Path(run.capture.names[i]).stem] for i in run.capture.loaded.train])
        np.testing.assert_allclose(told, np.stack([camera.position for camera in again.train_cameras]), atol=1e-4)
