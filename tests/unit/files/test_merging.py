"""Blocks that are trained alone and merged: no anchor twice, and nothing but anchors of their own block."""

import json
import shlex
from dataclasses import replace

import pytest
import torch

from scene_experts import cli
from scene_experts.core.errors import InputError
from scene_experts.data.blocks import read_plan
from scene_experts.files.merging import merge_blocks
from scene_experts.scene.poses import Poses
from scene_experts.training import run_folder
from scene_experts.training.run_folder import open_run
from support.scenes import CAMERA
from support.synthetic import make_capture


def call(*words) -> None:
    assert cli.main([str(word) for word in words]) == 0


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A plan of two blocks with their runs."""
    place = tmp_path_factory.mktemp("merging")
    capture = make_capture(place / "box", views=9, size=(48, 32), points=400).folder
    plan = place / "plan"
    call("blocks", "plan", capture, "--out", plan, "--blocks", 2, "--share", 0.5)
    grow = ["--growth.adjust.interval", 20, "--growth.success-threshold", 0.05, "--preview-every", 0, "--device", "cpu"]
    train = ["train", "moe-gs", "--data", capture, "--iterations", 120, *grow]
    call(*train, "--out", plan / "coarse", "--stop-at", 40)
    for number in range(2):
        views = ["--views", plan / f"block{number}.json", "--init-from", plan / "coarse"]
        call(*train, "--out", plan / f"run{number}", *views, "--rates.networks", 0)
    return capture, plan


@pytest.mark.slow
def test_merged_blocks_have_no_anchor_twice(trained, tmp_path):
    capture, plan = trained
    runs = [plan / "run0", plan / "run1"]
    merge_blocks(plan, runs, tmp_path / "merged")
    merged, parts = open_run(tmp_path / "merged"), [open_run(run) for run in runs]
    cells = merged.scene.table.facts["cell"]
    assert len(cells.unique(dim=0)) == len(cells)
    _, blocks = read_plan(plan)
    inside = [block.holds(part.scene.positions.detach()) for block, part in zip(blocks, parts)]
    assert len(cells) == sum(int(rows.sum()) for rows in inside) and all(rows.any() and not rows.all() for rows in inside)
    feature = torch.cat([part.scene.table.params["feature"].detach()[rows] for part, rows in zip(parts, inside)])
    assert torch.equal(merged.scene.table.params["feature"].detach(), feature)
    call(
        "train",
        "moe-gs",
        "--data",
        capture,
        "--iterations",
        132,
        "--init-from",
        merged.path,
        "--out",
        tmp_path / "joint",
        "--device",
        "cpu",
    )
    call("eval", tmp_path / "joint")
    assert json.loads((tmp_path / "joint" / "results.json").read_text())["psnr"] > 10
    with pytest.raises(InputError, match="2 runs"):
        merge_blocks(plan, runs[:1], tmp_path / "other")


@pytest.mark.slow
def test_a_block_with_the_rate_keeps_its_masks_and_gives_up_its_steps(trained, tmp_path):
    capture, plan = trained
    views = ["--views", plan / "block0.json", "--init-from", plan / "coarse", "--rates.networks", 0, "--rate", 0.3, "--preview-every", 0]
    call("train", "moe-gs", "--data", capture, "--iterations", 60, *views, "--device", "cpu", "--out", tmp_path / "rated")
    rated = open_run(tmp_path / "rated").scene
    assert rated.steps is not None and "class" in rated.table.facts
    merge_blocks(plan, [tmp_path / "rated", plan / "run1"], tmp_path / "merged")
    merged = open_run(tmp_path / "merged").scene
    assert merged.steps is None and "class" not in merged.table.facts
    assert merged.table.facts["slots"].shape == (len(merged.table), 10)
    call(
        "train",
        "moe-gs",
        "--data",
        capture,
        "--iterations",
        64,
        "--init-from",
        tmp_path / "rated",
        "--out",
        tmp_path / "on",
        "--device",
        "cpu",
    )
    assert open_run(tmp_path / "on").scene.steps is None


@pytest.mark.slow
def test_runs_that_do_not_fit_are_named(trained, tmp_path):
    capture, plan = trained
    train = ["train", "moe-gs", "--data", capture, "--iterations", 50, "--preview-every", 0, "--device", "cpu"]
    call(*train, "--init-from", plan / "coarse", "--out", tmp_path / "moved")
    with pytest.raises(InputError, match=r"moved.*--rates\.networks 0"):
        merge_blocks(plan, [plan / "run0", tmp_path / "moved"], tmp_path / "out")
    call(*train, "--out", tmp_path / "fresh", "--split", "mod:3")
    with pytest.raises(InputError, match="fresh"):
        merge_blocks(plan, [plan / "run0", tmp_path / "fresh"], tmp_path / "out")
    assert not (tmp_path / "out").exists()
    assert cli.main([str(word) for word in (*train, "--init-from", tmp_path / "fresh", "--out", tmp_path / "x")]) == 2
    assert cli.main([str(word) for word in (*train, "--init-from", tmp_path, "--out", tmp_path / "x")]) == 2


def test_each_block_needs_its_run(tmp_path):
    box = {"low": [None] * 3, "high": [None] * 3, "views": ["a.png"]}
    (tmp_path / "plan.json").write_text(json.dumps({"format": 1, "capture": "", "blocks": [box, box]}))
    with pytest.raises(InputError, match="2 runs"):
        merge_blocks(tmp_path, [tmp_path], tmp_path / "out")
    with pytest.raises(InputError, match=r"config\.json"):
        merge_blocks(tmp_path, [tmp_path, tmp_path], tmp_path / "out")


@pytest.fixture
def planned(tmp_path):
    """A plan of two blocks whose commands have trained the coarse scene and the blocks, the second one until half of its iterations."""
    capture = make_capture(tmp_path / "box", views=6, size=(24, 16), points=100).folder
    more = "--train=--preview-every 0 --device cpu"
    call("blocks", "plan", capture, "--out", tmp_path / "plan", "--blocks", 2, "--iterations", 12, more)
    coarse, first, second, *_ = (shlex.split(line)[1:] for line in (tmp_path / "plan/commands.sh").read_text().splitlines()[2:])
    for words in (coarse, first, [*second, "--stop-at", "6"]):
        call(*words)
    return tmp_path / "plan", second


def test_runs_in_another_order_than_the_plan_are_refused(planned, tmp_path):
    plan, _ = planned
    with pytest.raises(InputError, match=r"block 0 at .*run1, found that of block 1; .*order"):
        merge_blocks(plan, [plan / "run1", plan / "run0"], tmp_path / "out")
    call("blocks", "plan", tmp_path / "box", "--out", tmp_path / "other", "--blocks", 2, "--margin", 0.3)
    with pytest.raises(InputError, match=r"block 0 at .*run0, found one of another plan"):
        merge_blocks(tmp_path / "other", [plan / "run0", plan / "run1"], tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_runs_with_other_camera_poses_are_refused(planned, tmp_path, monkeypatch):
    plan, _ = planned
    runs = [plan / "run0", plan / "run1"]
    poses = {runs[0]: "1 0 0 1 0 0 0 1 0", runs[1]: "2 0 0 1 0 0 0 1 0"}
    monkeypatch.setattr(run_folder, "open_run", lambda path: replace(open_run(path), poses=poses[path]))
    with pytest.raises(InputError, match=r"camera poses in \S*" + runs[1].name):
        merge_blocks(plan, runs, tmp_path / "merged")


def test_runs_with_refined_poses_are_refused(planned, tmp_path, monkeypatch):
    def refined(path):
        run = open_run(path)
        run.scene.poses = Poses([CAMERA], 1.0)
        return run

    plan, _ = planned
    monkeypatch.setattr(run_folder, "open_run", refined)
    with pytest.raises(InputError, match=r"refined ones in .*; train it without --refine-poses"):
        merge_blocks(plan, [plan / "run0", plan / "run1"], tmp_path / "merged")


def test_runs_with_learned_exposures_are_refused(planned, tmp_path, monkeypatch):
    def learned(path):
        run = open_run(path)
        run.scene.exposures = object()
        return run

    plan, _ = planned
    monkeypatch.setattr(run_folder, "open_run", learned)
    with pytest.raises(InputError, match=r"without learned exposures.*; train it without --exposure"):
        merge_blocks(plan, [plan / "run0", plan / "run1"], tmp_path / "merged")


def test_a_block_whose_training_has_not_ended_is_told(planned, tmp_path, caplog):
    plan, second = planned
    config = plan / "run1/config.json"  # as after a signal: stopped, but not by --stop-at
    config.write_text(json.dumps(json.loads(config.read_text()) | {"stop_at": None}))
    merge_blocks(plan, [plan / "run0", plan / "run1"], tmp_path / "early")
    assert "block 1 ended at iteration 6 of 12" in caplog.text and "block 0" not in caplog.text
    call(*second, "--resume")
    caplog.clear()
    merge_blocks(plan, [plan / "run0", plan / "run1"], tmp_path / "merged")
    assert "ended at" not in caplog.text


@pytest.mark.parametrize("planes, expected", [((0.5, 0.2), 0.2), ((0.5, None), None)])
def test_the_merged_scene_has_the_least_near_plane(planned, tmp_path, planes, expected):
    plan, _ = planned
    for number, near in enumerate(planes):
        place = plan / f"run{number}" / "config.json"
        value = json.loads(place.read_text())
        value["data"]["near"] = near
        place.write_text(json.dumps(value))
    merge_blocks(plan, [plan / "run0", plan / "run1"], tmp_path / "merged")
    assert open_run(tmp_path / "merged").config.data.near == expected


@pytest.mark.parametrize("mean, expected", [((True, True), (0.3, 0.2, 0.15)), ((True, False), (0.2, 0.2, 0.2))])
def test_the_merged_scene_has_the_mean_of_mean_backgrounds(planned, tmp_path, mean, expected):
    plan, _ = planned
    for number, (colour, asked) in enumerate(zip(((0.2, 0.2, 0.2), (0.4, 0.2, 0.1)), mean)):
        place = plan / f"run{number}" / "config.json"
        value = json.loads(place.read_text())
        value["data"]["background"], value["train"]["mean_background"] = colour, asked
        place.write_text(json.dumps(value))
    merge_blocks(plan, [plan / "run0", plan / "run1"], tmp_path / "merged")
    assert open_run(tmp_path / "merged").config.data.background == expected
