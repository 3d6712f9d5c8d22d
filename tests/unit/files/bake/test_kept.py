"""The bake that a run keeps: the same files without a new bake, and a new one where anything differs."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.files.bake import kept
from scene_experts.files.bake.bake import Bake, Refine, bake
from scene_experts.files.export import Options, export
from scene_experts.render import choose
from scene_experts.training import run_folder
from support.captures import load
from support.files import run_in_memory
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=5, size=(24, 16), points=60).folder


def silent(what: str, done: int, total: int) -> None:
    pass


def test_it_comes_back_for_the_same_scene_cameras_and_settings_only(folder, tmp_path):
    capture, how = load(folder), Bake(sh_degree=0, refine=Refine(iterations=2))
    run = replace(run_in_memory("moe-gs", 10), path=tmp_path)
    run = replace(run, scene=run.config.train.scaled_scene().start(capture.points, capture.extent, []))
    assert kept.load(run, capture, how) is None
    made = bake(run, capture, how, choose("auto", "cpu"), silent)
    kept.keep(run, capture, how, made)
    found = kept.load(run, capture, how)
    assert found is not None and found.closed_form is None and found.about == made.about
    ours, theirs = made.scene.table.params, found.scene.table.params
    assert ours.keys() == theirs.keys() and all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert kept.load(run, capture, replace(how, sh_degree=1)) is None
    assert kept.load(replace(run, step=11), capture, how) is None
    assert kept.load(run, replace(capture, background=(1.0, 1.0, 1.0)), how) is None
    with torch.no_grad():
        run.scene.table.params["offsets"] += 1
    assert kept.load(run, capture, how) is None
    (tmp_path / kept.FILE).write_bytes(b"damaged")
    assert kept.load(run, capture, how) is None


def test_a_second_export_bakes_nothing_and_writes_the_same(folder, tmp_path):
    from scene_experts.cli import main

    run = tmp_path / "run"
    words = ["--data", str(folder), "--out", str(run), "--iterations", "20", "--device", "cpu", "--preview-every", "0"]
    assert main(["train", "scaffold-gs", *words]) == 0
    opened, options, said = run_folder.open_run(run), Options(sh_degree=1, refine=2, measure=False), []
    (first,) = export(opened, "ply", tmp_path / "a.ply", options)
    (second,) = export(opened, "ply", tmp_path / "b.ply", options, tell=lambda *what: said.append(what[0]))
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes() and not said
    assert "baked in" in first.lines[1] and "of the run's bake" in second.lines[1]
    notes = [json.loads((tmp_path / f"{name}.ply.json").read_text()) for name in "ab"]
    assert notes[0]["bake"] == notes[1]["bake"] and notes[1]["seconds"] == 0
