"""Expert shares against counts by hand."""

from __future__ import annotations

import math

import pytest
import torch

from scene_experts.core.types import Routing
from scene_experts.evaluate.experts import expert_shares, shares


def test_counts_by_hand() -> None:
    gates = torch.tensor([[0.5, 0.3, 0.2], [0.6, 0.1, 0.3], [0.1, 0.2, 0.7], [0.4, 0.35, 0.25]])
    chosen = torch.tensor([[0, 1], [0, 2], [2, 1], [0, 1]])
    found = shares(Routing(gates, chosen))
    assert found.k == 2
    assert found.per_anchor == pytest.approx([3 / 4, 3 / 4, 2 / 4]) and sum(found.per_anchor or []) == pytest.approx(2)
    assert found.share == pytest.approx([3 / 8, 3 / 8, 2 / 8]) and sum(found.share or []) == pytest.approx(1)
    assert found.first == pytest.approx([3 / 4, 0, 1 / 4])
    assert found.mean_gate == pytest.approx([0.4, 0.2375, 0.3625])
    assert found.entropy == pytest.approx(float(-(gates * gates.log()).sum(1).mean()) / math.log(3), rel=1e-6)


def test_balanced_and_collapsed() -> None:
    even = torch.full((10, 5), 0.2)
    assert shares(Routing(even, None)).entropy == pytest.approx(1.0)
    one = torch.zeros(10, 5)
    one[:, 3] = 1.0
    found = shares(Routing(one, torch.full((10, 1), 3)))
    assert found.entropy == 0.0 and found.share == [0, 0, 0, 1, 0]


def test_dense_has_no_assignments() -> None:
    found = shares(Routing(torch.tensor([[0.9, 0.1], [0.2, 0.8]]), None))
    assert found.share is None and found.per_anchor is None and found.k is None
    assert found.first == [0.5, 0.5] and found.mean_gate == pytest.approx([0.55, 0.45])


def test_no_anchors() -> None:
    found = shares(Routing(torch.zeros(0, 3), torch.zeros(0, 2, dtype=torch.int64)))
    assert found.share == [0, 0, 0] and found.entropy == 0.0


def test_all_anchors_of_a_scene() -> None:
    class Scene:
        def routing(self, step: int) -> dict[str, Routing]:
            return {"color": Routing(torch.eye(2), torch.tensor([[0], [1]]))} if step > 5 else {}

    assert expert_shares(Scene(), 6)["color"].share == [0.5, 0.5]
    assert expert_shares(Scene(), 5) == {}
