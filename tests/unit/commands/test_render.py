"""`scene-experts render` as a user runs it, on a run of a few iterations."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from PIL import Image

import scene_experts as se
from scene_experts import cli
from scene_experts.arguments.parse import Command, parse
from scene_experts.commands.render import RenderCommand, name_shown
from scene_experts.core.errors import InputError
from scene_experts.data.views import World
from scene_experts.evaluate import pictures
from scene_experts.training import run_folder
from scene_experts.view.film import expect_one_capture, make_film
from scene_experts.view.film_options import FilmOptions
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("render")
    capture = make_capture(root / "box", views=9).folder
    assert (
        cli.main(["train", "moe-gs", "--data", str(capture), "--out", str(root / "run"), "--iterations", "60", "--preview-every", "0"]) == 0
    )
    return root / "run"


def test_pictures_beside_each_other_and_the_path_as_a_file(run, tmp_path, capsys):
    args = ["render", str(run), "--out", str(tmp_path / "frames"), "--size", "48x32", "--fps", "4", "--seconds", "1", "--path", "orbit"]
    assert cli.main([*args, "--show", "picture", "experts", "--save-path", str(tmp_path / "p.json")]) == 0
    assert "4 frames" in capsys.readouterr().out
    assert pictures.read_picture(tmp_path / "frames" / "00003.png").shape == (32, 2 * 48 + 4, 3)
    assert len(json.loads((tmp_path / "p.json").read_text())["keyframes"]) == 4
    again = ["render", str(run), "--out", str(tmp_path / "again"), "--path", str(tmp_path / "p.json"), "--show", "picture"]
    assert cli.main(again) == 0
    first, second = (pictures.read_picture(tmp_path / name / "00002.png")[:, :48].astype(int) for name in ("frames", "again"))
    assert abs(first - second).mean() < 1


def test_views_of_several_sizes_are_no_video(run, tmp_path):
    pytest.importorskip("imageio_ffmpeg")
    args = ["render", str(run), "--path", "test", "--out"]
    assert cli.main([*args, str(tmp_path / "frames")]) == 0
    assert len({pictures.read_picture(path).shape for path in (tmp_path / "frames").glob("*.png")}) == 2
    assert cli.main([*args, str(tmp_path / "x.mp4")]) == 2 and not (tmp_path / "x.mp4").exists()
    assert cli.main([*args, str(tmp_path / "x.mp4"), "--size", "48x32"]) == 0 and (tmp_path / "x.mp4").stat().st_size > 0


def test_depth_in_a_folder_is_that_of_the_layers_and_of_named_photographs(run, tmp_path):
    args = ["render", str(run), "--path", "test", "--show", "depth", "--out", str(tmp_path)]
    assert cli.main(args) == 0
    opened = se.open_run(run)
    layers = opened.render_layers(opened.test_cameras[0])
    with Image.open(tmp_path / "00000.tiff") as found:
        assert np.allclose(np.array(found), layers.depth, rtol=1e-5)
    assert layers.depth.max() > 0
    held = [opened.capture.names[i] for i in opened.capture.loaded.test]
    assert json.loads((tmp_path / "frames.json").read_text())["photographs"] == held


def test_the_held_out_views_beside_another_run(run, tmp_path):
    args = ["render", str(run), "--path", "test", "--beside", str(run), "--out", str(tmp_path / "t"), "--only", "1", "2"]
    assert cli.main(args) == 0 and len(list((tmp_path / "t").glob("*.png"))) == 2


def test_a_run_of_another_world_is_drawn_in_its_own(run):
    opened = run_folder.open_run(run)
    capture = run_folder.capture_of(opened)
    other = World(3.0, (7.0, -2.0, 5.0))
    views = tuple(replace(view, camera=replace(view.camera, near=0.7)) for view in capture.views)
    elsewhere = replace(capture, world=other, views=views)
    film = make_film(FilmOptions(path="test"), [opened, opened], [capture, elsewhere])
    camera = film.path.cameras[0]
    assert film.seen_in(capture, camera) is camera
    seen = film.seen_in(elsewhere, camera)
    place = other.from_input(capture.world.to_input(camera.position.double()))
    torch.testing.assert_close(seen.position.double(), place, rtol=1e-5, atol=1e-4)
    assert seen.near == 0.7 and seen.world_to_cam.dtype == camera.world_to_cam.dtype
    capture.images.close()


def test_a_video_lands_in_the_run_folder(run, capsys):
    pytest.importorskip("imageio_ffmpeg")
    assert cli.main(["render", str(run), "--path", "spiral", "--size", "32x32", "--seconds", "0.5"]) == 0
    assert (run / "renders" / "spiral.mp4").stat().st_size > 500


def test_a_run_with_other_camera_poses_is_not_shown_beside(run):
    opened = run_folder.open_run(run)
    expect_one_capture([opened, opened])
    moved = replace(opened, poses="; ".join(f"{x} 0 0 1 0 0 0 1 0" for x in range(4)))
    with pytest.raises(InputError, match="one capture"):
        expect_one_capture([opened, moved])


def test_a_run_beside_another_has_its_own_background_and_near_plane(run, tmp_path):
    other = tmp_path / "other"
    data = str(run_folder.read_config(run).data.path)
    words = ["train", "one-network", "--data", data, "--out", str(other), "--iterations", "30", "--preview-every", "0"]
    assert cli.main([*words, "--background", "0.9", "0.1", "0.4", "--near", "1.7", "--device", "cpu"]) == 0
    show = ["--path", "test", "--out"]
    for name, runs in (("alone", [other]), ("beside", [run, "--beside", other])):
        assert cli.main(["render", *map(str, runs), *show, str(tmp_path / name)]) == 0
    alone, both = (np.array(Image.open(tmp_path / name / "00000.png")) for name in ("alone", "beside"))
    assert np.array_equal(both[:, -alone.shape[1] :], alone)


@pytest.mark.parametrize(("path", "said"), [("orbit", "--path spiral or views stays"), ("spiral", "fog; --path views stays")])
def test_a_path_away_from_the_photographs_is_warned_of(run, tmp_path, monkeypatch, capsys, path, said):
    monkeypatch.setattr("scene_experts.view.paths.count_unseen", lambda path, capture: len(path))
    assert cli.main(["render", str(run), "--path", path, "--out", str(tmp_path), "--size", "16x16", "--frames", "2"]) == 0
    assert said in capsys.readouterr().err


def test_flags_that_no_video_can_have(run, tmp_path, capsys):
    for wrong, fact in (
        (["--quality", "20"], "--quality"),
        (["--fps", "0"], "--fps"),
        (["--only", "9"], "1 to 5"),
        (["--out", str(tmp_path / "a.gif")], ".mp4"),
        (["--path", "bogus"], "bogus"),
    ):
        assert cli.main(["render", str(run), *wrong]) == 2
        assert fact in capsys.readouterr().err


def test_runs_of_two_worlds_beside_each_other(run, tmp_path):
    """One was trained in the capture's own units: it is drawn as it is alone."""
    other, folder = tmp_path / "other", run_folder.read_config(run).data.path
    words = ["--data", str(folder), "--out", str(other), "--iterations", "5", "--device", "cpu", "--preview-every", "0"]
    assert cli.main(["train", "scaffold-gs", *words, "--normalise", "none"]) == 0
    worlds = [run_folder.capture_of(run_folder.open_run(one)).world for one in (run, other)]
    assert worlds[0] != worlds[1]
    for first, more in ((other, []), (run, ["--beside", str(other)])):
        assert cli.main(["render", str(first), *more, "--path", "test", "--out", str(tmp_path / first.name)]) == 0
    alone, both = (pictures.read_picture(tmp_path / one.name / "00000.png").astype(int) for one in (other, run))
    assert abs(both[:, -alone.shape[1] :] - alone).mean() < 0.5


def test_videos_of_other_things_have_other_names():
    words = [["--only", "2", "1"], ["--beside", "runs/b"], ["--step", "300"], ["--attribute", "cov"], ["--show", "depth", "alpha"]]
    made = [name_shown(parse(RenderCommand, Command("render", ("run",)), ["run", *more])) for more in [[], *words]]
    assert made == ["", "_only2-1", "_beside-b", "_300", "_cov", "_depth_alpha"]
