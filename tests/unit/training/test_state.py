"""The state of a training becomes named tensors and back without loss. A state of another configuration is refused."""

from dataclasses import replace

import pytest
import torch

from scene_experts import cli
from scene_experts.core.errors import InputError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.scene import restore_scene
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from scene_experts.training.run_folder import open_run
from scene_experts.training.state import Training, resume, save
from support.captures import load
from support.messages import naming
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    capture = load(make_capture(tmp_path_factory.mktemp("capture"), views=8).folder)
    yield capture
    capture.images.close()


def started(capture, recipe="moe-gs") -> Training:
    training = Training.start(RECIPES[recipe][1].scaled(), capture, "cpu")
    for parameter in (p for group in training.optimizer.param_groups for p in group["params"]):
        parameter.grad = torch.ones_like(parameter)
    training.step = 7
    training.set_rates()
    training.optimizer.step()
    training.next_view(capture.train)
    return training


@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs"])
def test_restored_is_what_was_taken(recipe, capture):
    before = started(capture, recipe)
    tensors = {k: v.clone() for k, v in before.tensors().items()}
    after = Training.restore(before.cfg, tensors, before.meta(), "cpu")
    found = after.tensors()
    assert found.keys() == tensors.keys()
    assert all(torch.equal(found[k], tensors[k]) for k in tensors)
    assert (after.step, after.queue, after.scene.meta()) == (7, before.queue, before.scene.meta())


def test_rates_are_those_of_the_step(capture):
    training = started(capture)
    rates = training.rates()
    assert rates["feature"] == pytest.approx(0.0075)
    assert rates["offsets"] == pytest.approx(training.cfg.rates.at("offsets", 7, training.cfg.iterations, capture.extent))
    assert rates.keys() == {group["name"] for group in training.optimizer.param_groups}


def test_each_view_comes_once_an_epoch(capture):
    training = Training.start(RECIPES["moe-gs"][1].scaled(), capture, "cpu")
    seen = [training.next_view(capture.train)[0] for _ in range(2 * len(capture.train))]
    half = len(capture.train)
    assert sorted(seen[:half]) == sorted(seen[half:]) == sorted(capture.train)


def test_another_configuration_is_refused(capture):
    training = started(capture)
    other = replace(training.cfg, seed=5)
    with pytest.raises(InputError, match=naming("seed", 0, 5)):
        Training.restore(other, training.tensors(), training.meta(), "cpu")


def test_networks_of_another_recipe_are_refused(capture):
    training = started(capture)
    with pytest.raises(InputError):
        restore_scene(RECIPES["scaffold-gs"][1].scene, training.tensors(), training.meta())


def test_saved_is_found_again_and_none_is_none(capture, tmp_path):
    training = started(capture)
    assert resume(training.cfg, tmp_path, "cpu") is None
    save(training, tmp_path, keep=2)
    found = resume(training.cfg, tmp_path, "cpu")
    assert found is not None and found.step == 7
    (next(tmp_path.glob("ckpt_*"))).write_bytes(b"torn")
    with pytest.raises(InputError, match=naming(tmp_path)):
        resume(training.cfg, tmp_path, "cpu")


def test_a_checkpoint_without_a_cpu_time_opens_and_it_stays_unknown(capture):
    training = started(capture)
    meta = {k: v for k, v in training.meta().items() if k not in ("cpu_seconds", "load")}
    after = Training.restore(training.cfg, training.tensors(), meta, "cpu")
    with after.clock.running():
        pass
    found = after.meta()
    assert found["cpu_seconds"] is None and found["seconds"] > meta["seconds"] and "start" not in found["load"]


def test_a_training_starts_from_exactly_the_scene_of_another(tmp_path):
    folder = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder
    cfg = replace(RECIPES["moe-gs"][1], iterations=40, average=replace(RECIPES["moe-gs"][1].average, span=0.5))
    words = ["--iterations", "40", "--average.span", "0.5", "--preview-every", "0", "--device", "cpu"]
    assert cli.main(["train", "moe-gs", "--data", str(folder), "--out", str(tmp_path / "run"), "--stop-at", "20", *words]) == 0
    capture = load(folder)
    training = Training.start_from(cfg.scaled(), tmp_path / "run", capture, "cpu", RunConfig(cfg, Data(folder)))
    capture.images.close()
    scene = open_run(tmp_path / "run").scene
    assert training.step == 20 and not training.optimizer.state
    for name, value in scene.table.columns().items():
        assert torch.equal(training.scene.table.columns()[name].detach(), value.detach()), name
    for name, value in scene.network_tensors().items():
        assert torch.equal(training.scene.network_tensors()[name], value), name
    for iterations, batch in ((20, 1), (60, 6)):
        with pytest.raises(InputError, match="--iterations"):
            other = replace(cfg, iterations=iterations, batch=batch)
            Training.start_from(other.scaled(), tmp_path / "run", capture, "cpu", RunConfig(other, Data(folder)))
    with pytest.raises(InputError, match="--init-from"):
        Training.start_from(cfg.scaled(), tmp_path, capture, "cpu", RunConfig(cfg, Data(folder)))


def test_a_start_in_another_world_or_from_other_views_or_networks_names_the_flag(tmp_path):
    folder, cfg = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder, RECIPES["scaffold-gs"][1]
    run_folder.prepare(tmp_path / "run", RunConfig(replace(cfg, iterations=100), Data(folder)), resume=False)

    def start(data, **scene):
        now = replace(cfg, scene=replace(cfg.scene, **scene))
        capture = captures.load(data)
        capture.images.close()
        return Training.start_from(now.scaled(), tmp_path / "run", capture, "cpu", RunConfig(now, data))

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
    assert Training.start_from(longer, tmp_path, capture, "cpu", now).step == 20
    training.step = 600  # after it
    save(training, tmp_path / "checkpoints", keep=1)
    with pytest.raises(InputError, match=naming(flag, 600)):
        Training.start_from(longer, tmp_path, capture, "cpu", now)
    assert Training.start_from(replace(cfg, iterations=1500).scaled(), tmp_path, capture, "cpu", now).step == 600


def test_backgrounds_are_random_after_their_iteration(capture):
    cfg = replace(RECIPES["moe-gs"][1], random_background=True, random_background_from=15_000, iterations=3000).scaled()
    training = Training.start(cfg, capture, "cpu")
    assert cfg.random_background_from == 1500
    for step, random in ((1, False), (1500, False), (1501, True), (3000, True)):
        training.step = step
        ((_, color),) = training.next_batch((0, 1))
        assert (color is not None) is random
