"""Training end to end on a small coloured capture made in code: off-centre principal points, views of different sizes."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.schedule import Every
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.scene.gaussians import Explicit
from scene_experts.strategy.split_clone import SplitClone
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Densified, Finished, Previewed, Saved, Started, Stepped, Stopped
from scene_experts.training.init_from import start_from
from scene_experts.training.job import Job
from scene_experts.training.loop import iterate
from scene_experts.training.measure import without_graph
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from support.captures import load
from support.golden import recorded_text
from support.lanes import slow_except
from support.messages import naming
from support.scenes import METHODS
from support.synthetic import make_capture
from support.trainings import assert_same, config, events, last_tensors, start_changed


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=16).folder


@pytest.mark.parametrize("recipe", slow_except(METHODS, "moe-gs"))
def test_resumed_equals_uninterrupted_bit_for_bit_while_rows_come_and_go(recipe, folder, tmp_path):
    cfg = config(recipe)
    edits = [e for e in events(cfg, folder, tmp_path / "whole", stop_at=80) if isinstance(e, Densified)]
    assert any(e.edit.grown for e in edits)
    list(events(cfg, folder, tmp_path / "parts", stop_at=30))
    kinds = [type(e) for e in events(cfg, folder, tmp_path / "parts", stop_at=60, resume=True)]
    assert kinds[0] is Started
    second = list(events(cfg, folder, tmp_path / "parts", stop_at=80, resume=True))
    assert second[0].step == 60
    assert_same(last_tensors(tmp_path / "whole"), last_tensors(tmp_path / "parts"))


def test_other_camera_poses_are_refused(folder, tmp_path):
    cfg, other = config(), make_capture(tmp_path / "other", views=16, scale=2.0).folder
    run_folder.prepare(tmp_path / "run", RunConfig(cfg, Data(folder)), resume=False)
    list(events(cfg, folder, tmp_path / "run", stop_at=20))
    with pytest.raises(InputError, match=naming(tmp_path / "run", "camera poses")):
        list(events(cfg, other, tmp_path / "run", stop_at=40, resume=True))
    with pytest.raises(InputError, match=naming(tmp_path / "run", "camera poses")):
        start_from(cfg.scaled(), tmp_path / "run", load(other), "cpu", RunConfig(cfg, Data(other)))


def test_a_run_goes_on_with_the_training_views_that_it_began_with(folder, tmp_path):
    def chosen(*names):
        (tmp_path / "views.json").write_text(json.dumps([f"view_{n:03}.png" for n in names]))
        return captures.load(Data(folder, views=tmp_path / "views.json"))

    cfg, out = config(), tmp_path / "run"
    list(events(cfg, folder, out, world=chosen(1, 2, 3), stop_at=5))
    for world in (chosen(4, 5, 6), load(folder)):
        with pytest.raises(InputError, match="--views"):
            list(events(cfg, folder, out, world=world, stop_at=10, resume=True))
    assert list(events(cfg, folder, out, world=chosen(3, 1, 2), stop_at=10, resume=True))[-1].step == 10


def test_stopping_saves_and_goes_on(folder, tmp_path):
    cfg, reasons = config(), []
    seen = []
    for event in events(cfg, folder, tmp_path, stop_at=60, stop=reasons, log_every=1):
        seen.append(event)
        if isinstance(event, Stepped) and event.step == 30:
            reasons.append("SIGTERM")
    assert isinstance(seen[-2], Saved) and seen[-1] == Stopped(30, "SIGTERM")
    rest = list(events(cfg, folder, tmp_path, stop_at=60, resume=True))
    assert rest[0].step == 30 and isinstance(rest[-1], Finished)


def test_events_tell_what_happened(folder):
    seen = list(events(config(), folder, stop_at=40, preview_every=20))
    steps = [e for e in seen if isinstance(e, Stepped)]
    assert [e.step for e in steps] == [10, 20, 30, 40]
    assert set(steps[-1].terms) == {"l1", "dssim", "volume", "opacity", "load"}
    assert set(steps[-1].routing) == {"opacity", "cov", "color"}
    assert all(sum(s) == pytest.approx(1, abs=1e-3) for s in steps[-1].routing.values())
    assert 0 < steps[-1].active < 1 and steps[-1].psnr > 5
    assert [e.step for e in seen if isinstance(e, Previewed)] == [20, 40]


def test_experts_without_loss_weights_and_one_expert_are_scaffold_gs_bit_for_bit(folder):
    scaffold = config("scaffold-gs")
    moe = config("moe-gs", loss=scaffold.loss)
    one = replace(moe, scene=replace(moe.scene, decoder=replace(moe.scene.decoder, num=1, top_k=1)))
    a, b = ([e.terms for e in events(c, folder, stop_at=30, log_every=5) if isinstance(e, Stepped)] for c in (scaffold, one))
    assert a == b


@pytest.mark.parametrize("scale", [100.0, 0.01])
@pytest.mark.slow
def test_the_unit_of_a_capture_does_not_matter(scale, folder, tmp_path):
    scaled = make_capture(tmp_path, views=16, scale=scale).folder
    a, b = ([e.terms for e in events(config(), f, stop_at=40, log_every=10) if isinstance(e, Stepped)] for f in (folder, scaled))
    for x, y in zip(a, b):
        assert x.keys() == y.keys() and all(y[k] == pytest.approx(x[k], rel=2e-3, abs=1e-6) for k in x)


@pytest.mark.parametrize("recipe", slow_except(METHODS, "3dgs-mcmc"))
def test_losses_follow_the_golden_curve(recipe, tmp_path, monkeypatch):
    """The first iterations at a fixed seed, Top-k from the 51st, in float64 by the reference parts, so that machines agree to 1e-3:
    in float32, or from a start with equal depths, Adam turns the rounding of another processor into 1 % within these iterations. Recorded
    by this test with SCENE_EXPERTS_RECORD=1."""
    monkeypatch.setattr(Training, "start", start_changed)
    cfg = RECIPES[recipe][1]
    if isinstance(cfg.scene, Explicit):  # through all degrees of the harmonics, four adjustments and a reset
        cfg = config(recipe, iterations=1000, max_anchors=130)
        cfg = replace(cfg, growth=replace(cfg.growth, reset_least=1)) if isinstance(cfg.growth, SplitClone) else cfg
    elif isinstance(cfg.scene, Anchors) and isinstance(cfg.scene.decoder, Experts):
        cfg = replace(cfg, scene=replace(cfg.scene, decoder=replace(cfg.scene.decoder, warmup=50)))
    folder = make_capture(tmp_path, views=8, size=(30, 20), points=100).folder
    last = 100 if isinstance(cfg.scene, Explicit) else 70
    seen = events(cfg, folder, rasterizer="reference", stop_at=last, log_every=5, dtype=torch.float64)
    curve = [sum(e.terms.values()) for e in seen if isinstance(e, Stepped)]
    golden = recorded_text(f"{recipe}.json", json.dumps([round(c, 8) for c in curve], indent=1) + "\n")
    assert curve == pytest.approx(json.loads(golden), rel=1e-3)


@pytest.mark.slow
def test_anchor_cap_holds(folder):
    n = next(e for e in events(config(), folder, stop_at=1) if isinstance(e, Started)).anchors
    capped = [e for e in events(config(max_anchors=n + 30), folder, stop_at=200) if isinstance(e, Densified)]
    assert max(e.edit.anchors for e in capped) <= n + 30 and any(e.edit.capped for e in capped)


@pytest.mark.slow
def test_memory_cap_stops_growth(folder, monkeypatch):
    monkeypatch.setattr("scene_experts.training.trial.check_start", lambda *args: None)
    capped = [e for e in events(config(), folder, stop_at=100, max_memory=0.002) if isinstance(e, Densified)]
    assert capped and not any(e.edit.grown for e in capped) and any(e.edit.capped for e in capped)


def test_a_memory_cap_measures_only_where_rows_may_be_added(folder, monkeypatch):
    asked: list[int] = []
    monkeypatch.setattr("scene_experts.training.loop.give_back", lambda: asked.append(1))
    made = config()
    made = replace(made, growth=replace(made.growth, adjust=Every(0, 200, 5)))  # scaled to 4
    list(events(made, folder, stop_at=8, max_memory=1000.0))
    assert not asked
    made = replace(made, growth=replace(made.growth, adjust=Every(0, 500, 5)))  # scaled to 10
    list(events(made, folder, stop_at=8, max_memory=1000.0))
    assert len(asked) == 2  # before and after iteration 5


def test_a_start_beyond_the_memory_cap_is_refused_before_anything_is_written(folder, tmp_path):
    with pytest.raises(InputError, match="--max-memory"):
        list(events(config(), folder, tmp_path / "run", stop_at=100, max_memory=0.001))
    assert not (tmp_path / "run").exists()


def test_a_capture_without_points_or_training_views_is_refused(folder):
    capture = load(folder)
    cfg = config()
    with pytest.raises(InputError, match="--init random"):
        list(events(cfg, folder, world=replace(capture, points=None)))
    with pytest.raises(InputError, match="--split"):
        list(events(cfg, folder, world=replace(capture, train=())))
    capture.images.close()


def test_a_view_that_sees_nothing_trains_on(folder):
    capture = load(folder)
    away = []
    for view in capture.views:
        pose = view.camera.world_to_cam.clone()
        pose[:3, 3] += torch.tensor([0.0, 0.0, -1000.0])
        away.append(replace(view, camera=replace(view.camera, world_to_cam=pose)))
    steps = [
        e for e in events(config(), folder, world=replace(capture, views=tuple(away)), stop_at=5, log_every=1) if isinstance(e, Stepped)
    ]
    capture.images.close()
    assert len(steps) == 5 and all(math.isfinite(v) for e in steps for v in e.terms.values()) and steps[-1].gaussians == 0


def test_random_background_and_another_configuration_on_resume(folder, tmp_path):
    list(events(config(random_background=True), folder, tmp_path, stop_at=5))
    with pytest.raises(InputError, match="--out"):
        list(events(config(), folder, tmp_path, stop_at=6, resume=True))
    with pytest.raises(InputError, match="scaffold-gs"):
        list(events(config("scaffold-gs"), folder, tmp_path, stop_at=6, resume=True))


def test_resuming_on_other_views_is_refused(folder, tmp_path):
    list(events(config(), folder, tmp_path, stop_at=3))
    capture = load(folder)
    with pytest.raises(InputError, match="--data"):
        list(events(config(), folder, tmp_path, world=replace(capture, train=capture.train[:2]), stop_at=6, resume=True))
    capture.images.close()


def test_losses_that_are_no_numbers_end_the_run_and_keep_its_checkpoint(folder, tmp_path, monkeypatch):
    list(events(config(), folder, tmp_path, stop_at=5))
    before = last_tensors(tmp_path)

    def broken(sample, weights):
        return {"l1": sample.render.image.mean() * (math.nan if sample.step > 8 else 1.0)}

    monkeypatch.setattr("scene_experts.training.loop.compute_terms", broken)
    with pytest.raises(RunError, match=naming("l1", "nan", 9)):
        list(events(config(), folder, tmp_path, stop_at=60, log_every=1, resume=True))
    assert_same(before, last_tensors(tmp_path))
    with pytest.raises(RunError, match=naming("l1", 9)):  # Adam finds it before the losses are reported or saved
        list(events(config(), folder, tmp_path, stop_at=60, log_every=20, save_every=11, resume=True))
    assert_same(before, last_tensors(tmp_path))
    with pytest.raises(RunError, match=naming("l1", 9)):  # before the stop
        stop: list[str] = []
        for event in events(config(), folder, tmp_path, stop_at=60, log_every=20, preview_every=10, stop=stop, resume=True):
            stop += ["SIGTERM"] if isinstance(event, Previewed) else []
    assert_same(before, last_tensors(tmp_path))


def test_more_anchors_than_the_cap_to_start_with_is_said(folder):
    with pytest.raises(InputError, match=naming(100, "--max-anchors")):
        list(events(config(max_anchors=100), folder, stop_at=1))
    with pytest.raises(InputError, match=naming(100, "--max-anchors")):
        list(events(config("3dgs", max_anchors=100), folder, stop_at=1))


def test_more_gaussians_than_the_recipes_own_cap_start_and_none_is_added(folder, caplog):
    made = config("3dgs-mcmc")
    made = replace(made, growth=replace(made.growth, max_anchors=100))
    done = list(events(made, folder, stop_at=3))
    assert isinstance(done[-1], Finished) and "100" in caplog.text


@pytest.mark.slow
def test_sparse_adam_moves_what_was_decoded(folder):
    capture, rasterize = load(folder), choose("reference", "cpu")
    cfg = replace(config(), sparse_adam=True)
    moved = {}
    for each in (cfg, replace(cfg, sparse_adam=False)):
        training = Training.start(each.scaled(), capture, "cpu")
        for _ in range(3):
            before = training.scene.table.params["feature"].detach().clone()
            done = iterate(training, Job(RunConfig(each, Data(folder))), capture, rasterize)
        moved[each.sparse_adam] = (training.scene.table.params["feature"].detach() != before).any(1).nonzero().squeeze(1)
        assert not each.loss.reaches_every_row(done.decoded)
        assert not each.sparse_adam or set(moved[True].tolist()) <= set(done.decoded.rows.tolist())
    capture.images.close()


def test_what_an_iteration_leaves_holds_no_graph(folder):
    capture = load(folder)
    training = Training.start(config().scaled(), capture, "cpu")
    done = iterate(training, Job(RunConfig(config(), Data(folder))), capture, choose("auto", "cpu"))
    tensors = [done.render.image, done.decoded.gaussians.means, done.decoded.raw_opacity, *done.terms.values()]
    assert not any(t.requires_grad for t in tensors)
    assert training.largest.gaussians == len(done.decoded.gaussians) and training.largest.pixels == done.target[..., 0].numel()
    x = torch.ones(1, requires_grad=True) * 2
    kept = without_graph(({"a": x}, [x, 3], None))
    assert not kept[0]["a"].requires_grad and not kept[1][0].requires_grad and kept[1][1:] == [3] and kept[2] is None
    capture.images.close()


def test_a_setting_without_an_effect_is_said_at_the_start(folder, caplog):
    made = config("scene-experts")
    made = replace(made, scene=replace(made.scene, decoder=replace(made.scene.decoder, expert_init="variance")))
    list(events(made, folder, stop_at=1))
    assert "--scene.decoder.expert-init" in caplog.text and caplog.text.count("effect") == 1
    caplog.clear()
    list(events(config("scene-experts"), folder, stop_at=1))
    assert "effect" not in caplog.text
