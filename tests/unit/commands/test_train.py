"""From the flags of `train` to what the loop is given."""

import signal
from pathlib import Path

import pytest

from scene_experts.api import recording
from scene_experts.arguments.parse import HelpAsked
from scene_experts.arguments.table import rows
from scene_experts.cli import main
from scene_experts.commands.train import FIRST, TrainCommand, after_restart, parse_train, run_of, train
from scene_experts.core.errors import InputError
from scene_experts.core.group import Alone
from scene_experts.training import run_folder
from scene_experts.training.recipes import RECIPES
from support.messages import naming
from support.synthetic import make_capture

PLACES = ["--data", "c", "--out", "r"]


def check_settings(command: TrainCommand) -> None:
    recording.check_settings(run_of(command, ""))


@pytest.mark.parametrize("recipe", list(RECIPES))
def test_a_recipe_without_flags_is_the_recipe(recipe):
    made = parse_train([recipe, *PLACES])
    assert made.cfg == RECIPES[recipe][1] and (made.data.path, made.out) == (Path("c"), Path("r"))
    check_settings(made)


@pytest.mark.parametrize(
    ("flag", "value"),
    [
        ("--stop-at", "0"),
        ("--save-every", "0"),
        ("--preview-every", "-1"),
        ("--max-memory", "-1"),
        ("--max-memory", "nan"),
        ("--iterations", "0"),
        ("--batch", "0"),
        ("--batch", "7"),
        ("--seed", "-1"),
        ("--max-anchors", "-1"),
        ("--scene.K", "0"),
        ("--scene.voxel-size", "-0.1"),
        ("--growth.adjust.interval", "0"),
    ],
)
def test_numbers_no_training_can_have_name_their_flag(flag, value):
    with pytest.raises(InputError, match=flag):
        check_settings(parse_train(["moe-gs", *PLACES, flag, value]))


def test_the_run_to_start_from_is_part_of_the_configuration(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert run_of(parse_train(["moe-gs", *PLACES, "--init-from", "coarse"]), "").config.init_from == tmp_path / "coarse"
    assert run_of(parse_train(["moe-gs", *PLACES]), "").config.init_from is None


def test_a_restarted_process_continues_a_run_that_had_begun(tmp_path):
    group = Alone()
    command = parse_train(["moe-gs", "--data", "c", "--out", str(tmp_path), "--overwrite"])
    assert after_restart(command, group) == command
    group.restarts = 1
    assert after_restart(command, group) == command
    (tmp_path / "config.json").touch()
    continued = after_restart(command, group)
    assert continued.options.resume and not continued.options.overwrite


def test_a_memory_cap_needs_a_system_that_tells(monkeypatch):
    made = parse_train(["moe-gs", "--data", "capture", "--out", "run", "--max-memory", "4"])
    check_settings(made)
    monkeypatch.setattr("scene_experts.api.recording.used_bytes", lambda device: 0)
    with pytest.raises(InputError, match="--max-anchors"):
        check_settings(made)


def test_an_unknown_recipe_names_the_nearest():
    with pytest.raises(InputError, match="'moe-gs'"):
        parse_train(["moegs", *PLACES])


def test_a_scene_of_the_paper_brings_its_numbers_and_flags_have_the_last_word():
    for data in (["--data", "catalog:truck"], ["--data=catalog:truck"], ["-s", "catalog:tandt/truck"]):
        made = parse_train(["scaffold-gs", *data, "--out", "run"])
        assert (made.data.normalise, made.cfg.scene.voxel_size) == ("none", 0.01)
    made = parse_train(["scaffold-gs", "--data", "catalog:truck", "--out", "run", "--scene.voxel-size", "0", "--normalise", "extent"])
    assert (made.data.normalise, made.cfg.scene.voxel_size) == ("extent", 0.0)
    assert parse_train(["3dgs", "--data", "catalog:truck", "--out", "run"]).data.normalise == "none"
    made = parse_train(["scaffold-gs", "--data", "truck", "--out", "run"])
    assert (made.data.normalise, made.cfg.scene.voxel_size) == ("extent", 0.0)


def test_flags_reach_the_parts_of_explicit_recipes():
    made = parse_train(["3dgs", *PLACES, "--growth.grad-threshold", "0.001", "--rates.means.first", "0.01", "--scene.sh-degree", "1"])
    assert (made.cfg.growth.grad_threshold, made.cfg.rates.means.first, made.cfg.scene.sh_degree) == (0.001, 0.01, 1)  # type: ignore[union-attr]
    with pytest.raises(InputError, match="sh-degree"):
        check_settings(parse_train(["3dgs-mcmc", *PLACES, "--scene.sh-degree", "4"]))


@pytest.mark.parametrize("flag", ["--help", "--help-all"])
def test_the_help_without_a_recipe_lists_methods_and_with_all_every_recipe_once(flag):
    with pytest.raises(HelpAsked) as asked:
        parse_train([flag])
    lines = str(asked.value).splitlines()
    before = lines[: lines.index("Examples:")]  # a line of an example begins with the name of the program
    named = [line.split()[0] for line in before if line.startswith("  ") and line.split()[0] in RECIPES]
    methods = ["3dgs", "3dgs-mcmc", "moe-gs", "octree-gs", "octree-moe-gs", "one-network", "sags", "scaffold-gs", "scene-experts"]
    assert sorted(named) == (sorted(RECIPES) if flag == "--help-all" else methods) and max(map(len, lines)) <= 80


@pytest.mark.parametrize("recipe", list(RECIPES))
def test_the_help_of_a_recipe_shows_what_people_use_first_and_help_all_the_rest(recipe):
    short, whole = (asked(recipe, flag) for flag in ("--help", "--help-all"))
    assert all(f"{flag} " in short for flag in FIRST[:6]) and "--help-all" in short and "--scene." not in short
    table = rows(TrainCommand, {"cfg": RECIPES[recipe][1]})
    assert all(row.flag in whole for row in table) and 2 * len(short) < len(whole)


def asked(*args: str) -> str:
    with pytest.raises(HelpAsked) as asked:
        parse_train(list(args))
    return str(asked.value)


def test_an_option_of_another_recipe_says_whose_it_is():
    with pytest.raises(InputError, match=r"--scene\.decoder\.num.*moe-gs") as error:
        parse_train(["scaffold-gs", *PLACES, "--scene.decoder.num", "3"])
    assert "octree-moe-gs" in str(error.value)


@pytest.mark.parametrize(
    ("args", "fact"), [([], "scaffold-gs --data"), (["--data", "x"], "--data"), (["--data", "x", "sags"], "train sags")]
)
def test_a_missing_recipe(args, fact):
    with pytest.raises(InputError, match=naming(fact)):
        parse_train(args)


def test_a_finished_run_keeps_its_files_when_resumed(tmp_path):
    capture = make_capture(tmp_path / "capture", views=9, size=(48, 32)).folder
    args = ["scaffold-gs", "--data", str(capture), "--out", str(tmp_path / "run"), "--iterations", "3", "--preview-every", "0"]
    assert train(args) == 0
    layout = tmp_path / "run" / "point_cloud" / "iteration_3"
    (layout / "point_cloud.ply").write_bytes(b"mine")
    assert train([*args, "--resume"]) == 0 and "--resume" not in run_folder.read_config(tmp_path / "run").command
    assert (layout / "point_cloud.ply").read_bytes() == b"mine"
    (layout / "point_cloud.ply").unlink()
    assert train([*args, "--resume"]) == 0 and (layout / "point_cloud.ply").is_file()  # a run that was killed before it wrote them


def test_a_signal_after_the_last_iteration_ends_a_whole_run_as_a_success(tmp_path, monkeypatch, capsys):
    capture, export = make_capture(tmp_path / "capture", views=9, size=(48, 32)).folder, recording.export_layout

    def interrupted(*args):
        signal.raise_signal(signal.SIGINT)
        return export(*args)

    monkeypatch.setattr(recording, "export_layout", interrupted)
    args = ["--data", str(capture), "--out", str(tmp_path / "run"), "--iterations", "3", "--preview-every", "0"]
    assert train(["scaffold-gs", *args]) == 0
    assert (tmp_path / "run" / "point_cloud" / "iteration_3" / "point_cloud.ply").is_file() and "next:" in capsys.readouterr().out


def test_two_trainings_into_one_folder(tmp_path):
    capture = make_capture(tmp_path / "capture", views=9, size=(48, 32)).folder
    args = ["scaffold-gs", "--data", str(capture), "--out", str(tmp_path / "run"), "--iterations", "3", "--preview-every", "0"]
    with run_folder.held(tmp_path / "run"), pytest.raises(InputError, match=naming(tmp_path / "run")):
        train(args)
    assert [p.name for p in (tmp_path / "run").iterdir()] == [".lock"]
    assert train(args) == 0


def test_a_run_that_is_resumed_where_it_stopped_says_how_to_go_on(tmp_path, capsys):
    folder = make_capture(tmp_path / "box", views=9, size=(24, 16), points=60).folder
    words = ["train", "scaffold-gs", "--data", str(folder), "--out", str(tmp_path / "run"), "--iterations", "20", "--stop-at", "10"]
    assert main([*words, "--device", "cpu", "--preview-every", "0"]) == 0
    capsys.readouterr()
    assert main([*words, "--device", "cpu", "--preview-every", "0", "--resume"]) == 0
    out = capsys.readouterr().out
    assert "already at iteration 10 of 20" in out and "larger --stop-at than 10 or none" in out and "--init-from" not in out
