"""Trainings that start from the scene of another run."""

from dataclasses import replace

import pytest
import torch

from scene_experts import cli
from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.init_from import start_from
from scene_experts.training.recipes import RECIPES
from scene_experts.training.run_folder import open_run
from scene_experts.training.state import Training, save
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=8).folder)
    yield capture
    capture.images.close()


def test_a_training_starts_from_exactly_the_scene_of_another(tmp_path):
    folder = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder
    cfg = replace(RECIPES["moe-gs"][1], iterations=40, average=replace(RECIPES["moe-gs"][1].average, span=0.5))
    words = ["--iterations", "40", "--average.span", "0.5", "--preview-every", "0", "--device", "cpu"]
    assert cli.main(["train", "moe-gs", "--data", str(folder), "--out", str(tmp_path / "run"), "--stop-at", "20", *words]) == 0
    capture = load(folder)
    training = start_from(cfg.scaled(), tmp_path / "run", capture, "cpu", RunConfig(cfg, Data(folder)))
    capture.images.close()
    scene = open_run(tmp_path / "run").scene
    assert training.step == 20 and not training.optimizer.state and training.box == ()
    for name, value in scene.table.columns().items():
        assert torch.equal(training.scene.table.columns()[name].detach(), value.detach()), name
    for name, value in scene.network_tensors().items():
        assert torch.equal(training.scene.network_tensors()[name], value), name
    tensors, meta = checkpoint.newest(tmp_path / "run" / "checkpoints")
    bounds = (-1.0, -1.5, -2.0, 1.0, 1.5, 2.0)  # of points far away
    checkpoint.save(tmp_path / "run" / "checkpoints", 20, tensors, {**meta, "box": list(bounds)})
    training = start_from(cfg.scaled(), tmp_path / "run", capture, "cpu", RunConfig(cfg, Data(folder)))
    assert training.box == open_run(tmp_path / "run").box == bounds
    for iterations, batch in ((20, 1), (60, 6)):
        with pytest.raises(InputError, match="--iterations"):
            other = replace(cfg, iterations=iterations, batch=batch)
            start_from(other.scaled(), tmp_path / "run", capture, "cpu", RunConfig(other, Data(folder)))
    other = RECIPES["scaffold-gs"][1]
    with pytest.raises(InputError, match=r"expected --init-from a run of 'scaffold-gs', found .* of 'moe-gs'"):
        start_from(other.scaled(), tmp_path / "run", capture, "cpu", RunConfig(other, Data(folder)))
    with pytest.raises(InputError, match="--init-from"):
        start_from(cfg.scaled(), tmp_path, capture, "cpu", RunConfig(cfg, Data(folder)))


def test_a_start_in_another_world_or_from_other_views_or_networks_names_the_flag(tmp_path):
    folder, cfg = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder, RECIPES["scaffold-gs"][1]
    run_folder.prepare(tmp_path / "run", RunConfig(replace(cfg, iterations=100), Data(folder)), resume=False)

    def start(data, **scene):
        now = replace(cfg, scene=replace(cfg.scene, **scene))
        capture = captures.load(data)
        capture.images.close()
        return start_from(now.scaled(), tmp_path / "run", capture, "cpu", RunConfig(now, data))

    capture = load(folder)
    first = Training.start(cfg.scaled(), capture, "cpu")
    first.capture_id, first.poses, first.step = capture.fingerprint(), capture.poses(), 10
    capture.images.close()
    save(first, tmp_path / "checkpoints", keep=1)
    (tmp_path / "checkpoints").rename(tmp_path / "run" / "checkpoints")
    assert start(Data(folder)).step == 10
    for data, scene, *words in (
        (Data(folder, normalise="none"), {}, "--normalise extent"),
        (Data(folder, resolution="longest:32"), {}, "resolution was auto, is now longest:32", "--resolution"),
        (Data(folder, max_views=5), {}, "max_views", "--max-views"),
        (Data(folder), {"K": 5}, "scene.K was 10, is now 5"),
        (Data(folder), {"hidden": 16}, "scene.hidden was 32, is now 16"),
        (Data(folder), {"appearance": 4}, "scene.appearance was 0, is now 4"),
    ):
        with pytest.raises(InputError, match=naming(tmp_path / "run", *words)):
            start(data, **scene)


@pytest.mark.parametrize(
    ("recipe", "flag"),
    [("scene-experts", "--scene.decoder.warmup"), ("octree-gs", "--scene.select.coarse-until"), ("3dgs", "--scene.sh-ramp")],
)
def test_a_longer_schedule_does_not_put_a_scene_back_into_a_phase_that_it_has_left(recipe, flag, capture, tmp_path):
    cfg = replace(RECIPES[recipe][1], iterations=1000)
    run_folder.prepare(tmp_path, RunConfig(cfg, Data(capture.root)), resume=False)
    training = Training.start(cfg.scaled(), capture, "cpu")
    now, longer = RunConfig(cfg, Data(capture.root)), replace(cfg, iterations=30_000).scaled()
    training.step = 20  # within the phase
    save(training, tmp_path / "checkpoints", keep=1)
    assert start_from(longer, tmp_path, capture, "cpu", now).step == 20
    training.step = 600  # after it
    save(training, tmp_path / "checkpoints", keep=1)
    with pytest.raises(InputError, match=naming(flag, 600)):
        start_from(longer, tmp_path, capture, "cpu", now)
    assert start_from(replace(cfg, iterations=1500).scaled(), tmp_path, capture, "cpu", now).step == 600
