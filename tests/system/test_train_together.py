"""Trainings side by side, and steps one by one, on the CPU."""

import json
import zipfile

import pytest

import profile_cuda
import train_together
from support.synthetic import make_capture


@pytest.fixture
def lines(tmp_path):
    path = tmp_path / "trainings.txt"
    path.write_text("# two schedules\nscaffold-gs --iterations 4\n\nscene-experts --iterations 6 --seed 1  # longer\n")
    return path


def test_a_line_is_a_training_in_its_own_folder(lines, tmp_path):
    found = train_together.read_trainings(lines, tmp_path)
    assert [training.words for training in found] == [
        ["scaffold-gs", "--iterations", "4"],
        ["scene-experts", "--iterations", "6", "--seed", "1"],
    ]
    assert [training.name for training in found] == ["scaffold-gs-iterations-4", "scene-experts-iterations-6-seed-1"]
    for text in ("# none\n", "moe-gs\nmoe-gs\n"):
        lines.write_text(text)
        with pytest.raises(SystemExit, match="one training a line"):
            train_together.read_trainings(lines, tmp_path)


def test_the_newest_step_that_all_have_saved_is_scored(lines, tmp_path):
    found = train_together.read_trainings(lines, tmp_path)
    for training, steps in zip(found, ((500, 1000, 10000), (1000, 1500))):
        training.checkpoints.mkdir(parents=True)
        for step in steps:
            path = training.checkpoints / f"ckpt_{step:06}.safetensors"
            path.write_text("")
            training.keep()
            path.unlink()  # as a training does with its older ones
    assert train_together.find_common(found) == "ckpt_001000.safetensors"
    (found[1].kept / "ckpt_001000.safetensors").unlink()
    assert train_together.find_common(found) is None


@pytest.mark.slow
def test_trainings_of_different_lengths_are_scored_at_the_same_step(lines, tmp_path, capsys):
    capture, out = make_capture(tmp_path / "capture", views=8, size=(24, 16), points=40), tmp_path / "out"
    lines.write_text("scaffold-gs --iterations 4 --split mod8\nscene-experts --iterations 6 --seed 1 --split mod8\n")
    words = ["--data", str(capture.folder), "--trainings", str(lines), "--out", str(out), "--save-every", "2", "--device", "cpu"]
    assert train_together.main([*words, "--seconds", "300"]) == 0
    scores = json.loads((out / "scores.json").read_text())
    assert [score["step"] for score in scores.values()] == [4, 4] and all(score["psnr"] > 0 for score in scores.values())
    names = zipfile.ZipFile(out / "scores.zip").namelist()
    assert "scaffold-gs-iterations-4-split-mod8/per_view.json" in names and 3 <= len(names) <= 6
    assert "step      4" in capsys.readouterr().out


@pytest.mark.slow
def test_steps_are_timed_and_a_recipe_that_fails_does_not_stop_the_others(tmp_path, capsys):
    capture = make_capture(tmp_path / "capture", views=4, size=(24, 16), points=40)
    words = ["--data", str(capture.folder), "--device", "cpu", "--rounds", "1"]
    assert profile_cuda.main([*words, "no-recipe@1000", "scaffold-gs@1000"]) == 1
    out = capsys.readouterr().out
    assert "no-recipe@1000: failed" in out and "scaffold-gs@1000" in out and "ms a step" in out
