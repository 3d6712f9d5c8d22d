"""Scripted trainings: events, pauses, stops, and the same bits as the command."""

import dataclasses
import inspect
import os
import shutil
import signal
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

import scene_experts as se
from scene_experts.api.trainer import Settings
from scene_experts.cli import main
from scene_experts.core import checkpoint
from scene_experts.core.errors import RunError
from scene_experts.data.settings import Data
from scene_experts.training.options import TrainOptions
from scene_experts.training.run_folder import read_config
from support.messages import naming

FLAGS = ["--iterations", "6", "--scene.voxel-size", "0.2", "--deterministic", "--device", "cpu", "--save-every", "3"]


def tensors(run: Path, step: int = 6) -> dict[str, torch.Tensor]:
    return checkpoint.load(run / f"checkpoints/ckpt_{step:06d}.safetensors")[0]


def files(run: Path) -> set[str]:
    return {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}


def test_a_scripted_training_is_the_command_bit_for_bit(folder, small, tmp_path):
    script, command = tmp_path / "script", tmp_path / "command"
    run = se.train(small, folder, script, deterministic=True, device="cpu", save_every=3, progress=False)
    assert not torch.are_deterministic_algorithms_enabled(), "the earlier choice is back"
    assert main(["train", "moe-gs", "--data", str(folder), "--out", str(command), *FLAGS]) == 0
    assert run.path == script and files(script) == files(command)
    for step in (3, 6):
        ours, theirs = tensors(script, step), tensors(command, step)
        assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    layout = "point_cloud/iteration_6/point_cloud.ply"
    assert (script / layout).read_bytes() == (command / layout).read_bytes()
    ours, theirs = read_config(script), read_config(command)
    assert replace(ours, command="") == replace(theirs, command="")


def test_the_commands_accept_a_scripted_run(folder, small, tmp_path, capsys):
    se.train(small, folder, tmp_path / "run", deterministic=True, device="cpu", stop_at=3, progress=False)
    run, flags = str(tmp_path / "run"), [word for word in FLAGS if word not in ("--save-every", "3")]
    assert main(["train", "moe-gs", "--data", str(folder), "--out", run, *flags, "--resume"]) == 0
    assert main(["eval", run, "--no-lpips"]) == 0 and main(["export", run, "--no-measure"]) == 0 and main(["report", run]) == 0
    whole = se.train(small, folder, tmp_path / "whole", deterministic=True, device="cpu", progress=False)
    ours, theirs = tensors(tmp_path / "run"), tensors(whole.path or Path())
    assert all(torch.equal(ours[name], theirs[name]) for name in ours), "resumed by the command, bit for bit"
    again = se.train(small, folder, tmp_path / "run", deterministic=True, device="cpu", resume=True, progress=False)
    assert again.step == 6
    capsys.readouterr()


def test_a_training_in_memory_is_the_same_scene(capture, small, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    kinds, trainer = [], se.Trainer(small, capture, preview_every=3)
    for event in trainer:
        kinds.append(type(event))
        if isinstance(event, se.Previewed):
            view = trainer.run.render(capture.test_cameras[0])
            assert np.allclose(view, event.picture.numpy(), atol=1e-6) and trainer.run.step == event.step
    assert kinds[0] is se.Started and kinds[-1] is se.Finished and se.Saved not in kinds and not list(tmp_path.iterdir())
    scene = trainer.run
    assert scene.path is None and scene.step == 6 and scene.seconds > 0 and "in memory" in repr(scene)
    camera = capture.test_cameras[0]
    assert np.allclose(scene.render(camera), run.render(camera), atol=2e-3)
    with pytest.raises(se.InputError, match="save"):
        scene.export("compact")
    saved = scene.save(tmp_path / "saved")
    assert np.allclose(saved.render(camera), scene.render(camera), atol=1e-6) and saved.export("compact").is_file()
    assert saved.evaluate(lpips=False).psnr == pytest.approx(scene.evaluate(lpips=False).psnr, abs=0.05)
    assert main(["train", "moe-gs", "--data", str(capture.path), "--out", str(tmp_path / "saved"), *FLAGS[:4], "--resume"]) == 0
    with pytest.raises(se.InputError):
        saved.save(tmp_path / "other")


def test_a_training_in_memory_shows_its_averaged_weights(capture, small, tmp_path):
    averaged = se.recipe(small, **{"average.span": 0.5, "average.interval": 1})
    looked = se.Trainer(averaged, capture, preview_every=3, deterministic=True, device="cpu")
    camera = capture.test_cameras[0]
    for event in looked:
        if isinstance(event, se.Previewed):
            assert np.allclose(looked.run.render(camera), event.picture.numpy(), atol=1e-6)
    scene = looked.run
    saved = scene.save(tmp_path / "saved")
    assert np.allclose(scene.render(camera), saved.render(camera), atol=1e-6) and len(scene.scene.table) == len(saved.scene.table)
    assert scene.evaluate(lpips=False).psnr == pytest.approx(saved.evaluate(lpips=False).psnr, abs=1e-4)
    unseen = se.train(averaged, capture, tmp_path / "unseen", deterministic=True, device="cpu", progress=False)
    ours, theirs = tensors(tmp_path / "saved"), tensors(unseen.path or Path())
    assert [n for n in ours if not torch.equal(ours[n], theirs[n])] == [], "looking changes nothing, and the raw weights are saved"
    assert any(not torch.equal(ours[name], ours[f"average.{name}"]) for name in ours if name.startswith("params."))


def test_a_loop_may_pause_go_on_and_stop(capture, small, tmp_path):
    trainer = se.Trainer(small, capture, tmp_path / "run", log_every=1)
    with pytest.raises(se.InputError, match="iterate"):
        _ = trainer.run
    for event in trainer:
        if isinstance(event, se.Stepped) and event.step == 2:
            break
    assert trainer.run.step == 2 and trainer.run.path is None and "step 2 of 6" in repr(trainer)
    last = None
    for last in trainer:
        if isinstance(last, se.Stepped) and last.step == 4:
            trainer.stop("enough")
    assert last == se.Stopped(4, "enough") and trainer.run.path == tmp_path / "run" and trainer.run.step == 4
    done = se.Trainer(small, capture, tmp_path / "run", resume=True).finish()
    assert done.step == 6 and list(trainer) == []


def digest(run: se.Run) -> list[float]:
    return [float(value.detach().double().sum()) for value in run.scene.table.params.values()]


def test_random_numbers_of_the_caller_change_no_training(capture):
    """With dropped anchors, which come from torch's own random numbers."""
    recipe = se.recipe("moe-gs", iterations=6, **{"scene.voxel_size": 0.2, "scene.dropout": 0.3, "scene.few_views": 0})
    expected = digest(se.train(recipe, capture, progress=False))
    torch.manual_seed(5)
    wanted = torch.rand(3)
    torch.manual_seed(5)
    first, second = (se.Trainer(recipe, capture, log_every=1, deterministic=True) for _ in range(2))
    for n, _ in enumerate(zip(first, second)):  # in turns
        assert not torch.are_deterministic_algorithms_enabled()
        assert n >= 3 or float(torch.rand(1)) == float(wanted[n])
    assert digest(first.finish()) == digest(second.finish()) == expected
    found: dict[int, list[float]] = {}

    def train(number: int) -> None:
        found[number] = digest(se.Trainer(recipe, capture, log_every=1).finish())

    threads = [threading.Thread(target=train, args=(number,)) for number in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert found == {0: expected, 1: expected}


def test_another_working_folder_does_not_move_the_run(capture, small, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trainer = se.Trainer(small, capture, "run", log_every=1)
    next(trainer)
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert trainer.finish().path == tmp_path / "run" and not list(Path().iterdir())
    assert "--out run" in read_config(tmp_path / "run").command


def test_a_folder_that_is_gone_is_not_a_full_disk(capture, small, tmp_path):
    trainer = se.Trainer(small, capture, tmp_path / "run", log_every=1)
    next(trainer)
    shutil.rmtree(tmp_path / "run")
    with pytest.raises(RunError, match=naming(str(tmp_path / "run"), "still there")) as raised:
        trainer.finish()
    assert "free some space" not in str(raised.value)


def test_ctrl_c_saves_and_is_raised(capture, tmp_path, monkeypatch):
    def interrupt(self: object, event: se.Event) -> None:
        if isinstance(event, se.Stepped) and event.step == 10:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("scene_experts.api.trainer.TrainingProgress.__call__", interrupt)
    before = signal.getsignal(signal.SIGINT)
    long = se.recipe("scaffold-gs", iterations=100_000, **{"scene.voxel_size": 0.2})
    with pytest.raises(KeyboardInterrupt):
        se.train(long, capture, tmp_path / "run", progress=False)
    assert signal.getsignal(signal.SIGINT) is before and se.open_run(tmp_path / "run").step == 10


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"resume": True}, "out"),
        ({"tensorboard": True}, "out"),
        ({"save_every": 0}, "save_every"),
        ({"save_every": 1.5}, "save_every.*1.5"),
        ({"preview_every": -1}, "preview_every"),
        ({"log_every": 0}, "log_every"),
        ({"stop_at": 0}, "stop_at"),
        ({"stop_at": 4.0}, "stop_at.*4.0"),
        ({"deterministic": 1}, "deterministic"),
        ({"max_memory": -1.0}, "max_memory"),
        ({"device": "gpu"}, "'gpu'"),
        ({"rasterizer": "opengl"}, "opengl"),
    ],
)
def test_settings_that_cannot_be_used_are_named(capture, settings, said):
    with pytest.raises(se.InputError, match=said) as error:
        se.Trainer("moe-gs", capture, **settings)
    assert "\n" not in str(error.value)


def test_a_number_of_the_recipe_is_told_from_a_setting(capture):
    with pytest.raises(se.InputError, match=r"found iterations.*recipe\(..., iterations=...\)"):
        se.train("moe-gs", capture, iterations=3)  # type: ignore[call-arg]


def test_numbers_of_numpy_are_written_as_plain_ones(folder, small, tmp_path):
    read = {"max_views": np.int64(8), "near": np.float32(0.25), "ignore_principal_point": np.bool_(True)}
    capture = se.load_capture(folder, background=(np.float32(0), 0, 1), **read)
    run = se.train(small, capture, tmp_path / "run", progress=False, stop_at=np.int64(4), deterministic=np.bool_(True))
    data = se.open_run(tmp_path / "run").capture.data
    assert run.step == 4 and (data.max_views, data.near, data.ignore_principal_point) == (8, 0.25, True)
    assert se.train(small, capture, progress=False).save(tmp_path / "saved").step == 6


def test_an_earlier_run_is_not_lost_by_accident(run, capture, small, folder):
    with pytest.raises(se.InputError, match="overwrite"):
        se.Trainer(small, capture, run.path)
    with pytest.raises(se.InputError):
        se.Trainer("moe-gs", folder / "absent")


def test_the_arguments_are_those_of_the_options():
    """Signatures are written out for readers and editors; names and defaults are those of the dataclasses."""
    for function, kind, own in ((se.Trainer, TrainOptions, set()), (se.load_capture, Data, {"seed", "path", "views"})):
        found = {name: p for name, p in inspect.signature(function).parameters.items() if p.kind is p.KEYWORD_ONLY}
        fields = {f.name: f.default for f in dataclasses.fields(kind)}
        assert found.keys() - own == fields.keys() - own
        differ = {name for name in found.keys() - own if found[name].default != fields[name]}
        assert differ <= {"normalise"}  # None: that of the scene of the catalog, or the default of `Data`
    assert TrainOptions.__dataclass_fields__.keys() == Settings.__annotations__.keys()


def test_opening_a_run_while_another_trains_changes_no_bit(capture, small, run, tmp_path):
    for name, looks in (("alone", False), ("watched", True)):
        for event in se.Trainer(small, capture, tmp_path / name, deterministic=True, device="cpu"):
            if looks and isinstance(event, se.Stepped):
                se.open_run(run.path)
    ours, theirs = tensors(tmp_path / "alone"), tensors(tmp_path / "watched")
    assert [name for name in ours if not torch.equal(ours[name], theirs[name])] == []
