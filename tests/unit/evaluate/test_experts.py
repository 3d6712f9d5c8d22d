"""Shares of experts against counts by hand, and the pictures of single experts."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.types import Mode, Routing
from scene_experts.evaluate import pictures
from scene_experts.evaluate.experts import (
    WIDEST,
    assign_gaussians,
    draw_expert_strip,
    draw_experts,
    measure_scene_shares,
    measure_shares,
    select_gaussians,
    write_expert_strips,
)
from scene_experts.render import choose
from support.scenes import CAMERA, start_scene


def test_counts_by_hand() -> None:
    gates = torch.tensor([[0.5, 0.3, 0.2], [0.6, 0.1, 0.3], [0.1, 0.2, 0.7], [0.4, 0.35, 0.25]])
    chosen = torch.tensor([[0, 1], [0, 2], [2, 1], [0, 1]])
    found = measure_shares(Routing(gates, chosen))
    assert found.k == 2
    assert found.per_anchor == pytest.approx([3 / 4, 3 / 4, 2 / 4]) and sum(found.per_anchor or []) == pytest.approx(2)
    assert found.share == pytest.approx([3 / 8, 3 / 8, 2 / 8]) and sum(found.share or []) == pytest.approx(1)
    assert found.first == pytest.approx([3 / 4, 0, 1 / 4])
    assert found.mean_gate == pytest.approx([0.4, 0.2375, 0.3625])
    assert found.entropy == pytest.approx(float(-(gates * gates.log()).sum(1).mean()) / math.log(3), rel=1e-6)


def test_balanced_and_collapsed() -> None:
    even = torch.full((10, 5), 0.2)
    assert measure_shares(Routing(even, None)).entropy == pytest.approx(1.0)
    one = torch.zeros(10, 5)
    one[:, 3] = 1.0
    found = measure_shares(Routing(one, torch.full((10, 1), 3)))
    assert found.entropy == 0.0 and found.share == [0, 0, 0, 1, 0]


def test_dense_has_no_assignments() -> None:
    found = measure_shares(Routing(torch.tensor([[0.9, 0.1], [0.2, 0.8]]), None))
    assert found.share is None and found.per_anchor is None and found.k is None
    assert found.first == [0.5, 0.5] and found.mean_gate == pytest.approx([0.55, 0.45])


def test_no_anchors() -> None:
    found = measure_shares(Routing(torch.zeros(0, 3), torch.zeros(0, 2, dtype=torch.int64)))
    assert found.share == [0, 0, 0] and found.entropy == 0.0


def test_all_anchors_of_a_scene() -> None:
    class Scene:
        def routing(self, step: int) -> dict[str, Routing]:
            return {"color": Routing(torch.eye(2), torch.tensor([[0], [1]]))} if step > 5 else {}

    assert measure_scene_shares(Scene(), 6)["color"].share == [0.5, 0.5]
    assert measure_scene_shares(Scene(), 5) == {}


def test_top_2_puts_every_gaussian_into_two_pictures():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    decoded = scene(CAMERA, 2000, Mode.DRAW, draw.visible)
    mine = assign_gaussians(decoded, "color", scene.K)
    assert mine.shape == (len(decoded.gaussians), 5) and (mine.sum(1) == 2).all()
    routing = decoded.routing["color"].chosen
    assert routing is not None
    for m in (0, len(decoded.gaussians) - 1):
        row = int(decoded.gaussians.source[m]) // scene.K
        assert set(mine[m].nonzero().flatten().tolist()) == set(routing[decoded.rows.tolist().index(row)].tolist())
    assert len(select_gaussians(decoded.gaussians, mine[:, 0])) == int(mine[:, 0].sum())


def test_while_dense_each_gaussian_is_in_the_picture_of_its_largest_gate():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    decoded = scene(CAMERA, 1, Mode.DRAW, draw.visible)
    assert (assign_gaussians(decoded, "cov", scene.K).sum(1) == 1).all()


def test_the_pictures():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    whole, each = draw_experts(scene, CAMERA, 2000, draw, torch.zeros(3))
    assert whole.shape == (32, 48, 3) and len(each) == 5 and each[0].shape == whole.shape
    assert whole.max() > 0.01 and any(not torch.equal(e, whole) for e in each)


def test_a_strip_holds_the_pictures_in_order():
    scene, draw = start_scene("moe-gs"), choose("auto", "cpu")
    whole, each = draw_experts(scene, CAMERA, 2000, draw, torch.zeros(3), "opacity")
    sheet = draw_expert_strip(scene, CAMERA, 2000, draw, torch.zeros(3), "opacity")
    panel = 48 + pictures.GAP
    assert sheet.shape == (pictures.BAR + 32, 6 * panel - pictures.GAP, 3) and len(each) == 5
    for i, picture in enumerate((whole, *each)):
        assert np.array_equal(sheet[pictures.BAR :, i * panel :][:, :48], pictures.to_8bit(picture))
    assert draw_expert_strip(scene, CAMERA, 2000, draw, torch.zeros(3), "opacity", 24).shape == (
        pictures.BAR + 16,
        6 * (24 + pictures.GAP) - pictures.GAP,
        3,
    )


@pytest.mark.parametrize(
    ("recipe", "names"), [("moe-gs", {"opacity.png", "cov.png", "color.png"}), ("scaffold-gs", set()), ("3dgs", set())]
)
def test_a_file_for_each_attribute_with_experts(recipe, names, tmp_path):
    large = replace(CAMERA, K=CAMERA.K * torch.tensor([[20.0], [20], [1]]), width=960, height=640)
    write_expert_strips(tmp_path, start_scene(recipe), large, 2000, choose("auto", "cpu"), torch.zeros(3))
    found = list((tmp_path / "experts").glob("*"))
    assert {path.name for path in found} == names
    for sheet in map(pictures.read_picture, found):
        assert sheet.shape[1] == 6 * (WIDEST + pictures.GAP) - pictures.GAP
        assert sheet[-320:, :WIDEST].max() > 20, "the picture is not black"


def test_a_scene_whose_experts_are_not_split_yet(tmp_path):
    write_expert_strips(tmp_path, start_scene("scene-experts"), CAMERA, 5, choose("auto", "cpu"), torch.zeros(3))
