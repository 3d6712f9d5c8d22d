"""The coarse scene: few anchors, as large as it should be, whose pictures are nearer to the whole's than those of its rows alone."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.plain import to_json
from scene_experts.data.views import World
from scene_experts.evaluate.metrics import psnr
from scene_experts.files import placed
from scene_experts.files.anchors import coarse, compact, layers
from scene_experts.files.anchors.precision import from_spread
from scene_experts.files.anchors.read import scene as scene_of
from scene_experts.files.anchors.rounding import rounded
from scene_experts.files.anchors.write import contents, describe
from scene_experts.files.codec import fit
from scene_experts.files.measure import Painter
from scene_experts.files.placed import place_cameras
from support.files import run_in_memory


def made(monkeypatch, recipe, iterations):
    monkeypatch.setattr(placed, "SIZE", (80, 60))
    for name, value in {"ITERATIONS": iterations, "LOOK": 10, "SHARE": 0.5, "LEAST": 5, "ROUNDS": 4, "VIEWS": 6}.items():
        monkeypatch.setattr(coarse, name, value)
    monkeypatch.setattr(fit, "STEPS", 10)
    run = run_in_memory(recipe)
    with torch.no_grad():
        for name, value in run.scene.table.params.items():
            value += 0.2 * torch.randn(value.shape, generator=torch.Generator().manual_seed(len(name)))
    data = contents(run, World(), describe(run, World()) | {"train": to_json(run.config.train)})
    data = replace(data, precision=from_spread(data.columns, data.networks))
    capture = place_cameras(run.path, run.scene.positions.double(), World())
    return run, capture, coarse.make_layers(run, data, World(), capture, None, lambda *_: None)


def test_the_coarse_scene_has_the_classes_places_and_networks_of_the_whole(monkeypatch):
    run, _, found = made(monkeypatch, "octree-gs", 3)
    data, part = found.data, found.coarse
    N = len(data.columns["xyz"])
    assert 0 < len(found.rows) < N and found.given.shape == (N,) and found.given.max() > 0
    assert torch.equal(part.cells, data.cells[found.rows]) and torch.equal(part.precision.classes, data.precision.classes[found.rows])
    assert part.columns["slots"].any(1).all() and part.networks is data.networks
    for name, shift in coarse.SHIFTS.items():
        assert torch.equal(part.precision.steps[name], data.precision.steps[name] * 2.0**shift)
    whole = layers.encode(data, found.rows, part, found.given)
    assert whole.size > len(compact.encode(data)[0])
    assert not any(parameter.grad is not None for parameter in run.scene.parameters())


@pytest.mark.slow
def test_a_fit_comes_nearer_to_the_pictures_at_the_wanted_size(monkeypatch):
    scores = []
    for iterations in (1, 60):
        run, capture, found = made(monkeypatch, "scaffold-gs", iterations)
        size = len(compact.encode(found.coarse)[0]) / len(compact.encode(found.data)[0])
        pictures = []
        for data in (found.data, found.coarse):
            painter = Painter.of(*scene_of(run, rounded(data, data.precision), World()))
            pictures.append([painter.picture(capture.views[i].camera, torch.zeros(3)).clamp(0, 1) for i in capture.train[:4]])
        scores.append(sum(psnr(a, b) for a, b in zip(*pictures)) / 4)
        assert size < 0.75
    assert scores[1] > scores[0] + 1


@pytest.mark.slow
def test_a_scene_of_few_anchors_is_coarse_as_a_whole(monkeypatch):
    monkeypatch.setattr(coarse, "LEAST", 10**6)
    monkeypatch.setattr(placed, "SIZE", (80, 60))
    run = run_in_memory("scaffold-gs")
    data = contents(run, World(), describe(run, World()) | {"train": to_json(run.config.train)})
    data = replace(data, precision=from_spread(data.columns, data.networks))
    found = coarse.make_layers(run, data, World(), place_cameras(run.path, run.scene.positions.double(), World()), None, lambda *_: None)
    assert len(found.rows) == len(data.columns["xyz"]) and found.coarse.columns["slots"].all()
