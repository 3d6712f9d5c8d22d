"""Scenes of anchors: where they start, what is added to them, and which anchors are drawn."""

import math

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode, Points
from scene_experts.scene.anchors.rates import Rates
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.training.recipes import RECIPES
from support.anchor_scenes import EVERYTHING, camera, scene


def test_initial_anchors_sit_on_the_lattice_one_per_voxel():
    points = torch.tensor([[0.0, 0, 0], [0.004, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0]], dtype=torch.float64)
    made = AnchorScene.from_points(Anchors(voxel_size=0.01), Points(points, torch.zeros(4, 3, dtype=torch.uint8)), 5.0)
    assert sorted(made.table.facts["cell"].tolist()) == [[0, 0, 0], [0, 20, 0], [10, 0, 0]]
    torch.testing.assert_close(made.table.facts["xyz"], made.table.facts["cell"] * 0.01)
    assert not made.table.params["feature"].any() and not made.table.params["offsets"].any()
    with pytest.raises(InputError, match="--init random"):
        AnchorScene.from_points(Anchors(), Points(points[:0], torch.zeros(0, 3, dtype=torch.uint8)), 5.0)


def test_a_chosen_voxel_that_keeps_nearly_every_point_is_said(caplog):
    points = Points(
        torch.rand(100, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), torch.zeros(100, 3, dtype=torch.uint8)
    )
    for config, said in ((Anchors(), False), (Anchors(voxel_size=0.3), False), (Anchors(voxel_size=1e-5), True)):
        caplog.clear()
        AnchorScene.from_points(config, points, 5.0)
        assert ("100 of 100" in caplog.text) == said


def test_rates_by_group():
    made = scene(RECIPES["moe-gs"][1].scene, n=4)
    groups, rates = made.rate_groups(), Rates(router_scale=0.5)
    assert list(groups) == ["feature", "offsets", "log_scaling", "opacity", "opacity.router", "cov", "cov.router", "color", "color.router"]
    assert sum(p.numel() for name, ps in groups.items() if name not in ("feature", "offsets", "log_scaling") for p in ps) == 35_925
    assert rates.at("offsets", 15_000, 30_000, 5.0) == pytest.approx(5.0 * 1e-3)
    assert rates.at("opacity.router", 15_000, 30_000, 5.0) == pytest.approx(0.5 * 2e-4)
    assert rates.at("feature", 1, 30_000, 5.0) == 0.0075


def test_new_rows_have_the_columns_of_the_table():
    made = scene(Anchors(), n=5)
    made.table.append(made.new_rows(torch.tensor([[16, 0, -16]]), 0.16, torch.ones(1, 32)))
    assert len(made.table) == 6 and float(made.table.params["log_scaling"][5, 0].detach()) == pytest.approx(math.log(0.16))


def test_dropped_anchors():
    made = scene(Anchors(dropout=0.4, dropout_full=100), n=2000)
    torch.manual_seed(0)
    shares = [1 - len(made(camera(), step, Mode.TRAIN, EVERYTHING).rows) / len(made.table) for step in (1, 50, 100, 1000)]
    assert shares == pytest.approx([0.004, 0.2, 0.4, 0.4], abs=0.04)
    assert len(made(camera(), 1000, Mode.DRAW, EVERYTHING).rows) == len(made.table)
