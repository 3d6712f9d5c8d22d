"""Visits of graph points, and the positions of new points."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.schedule import Every
from scene_experts.core.types import Decoded, Gaussians, Render
from scene_experts.strategy.grow import GrowAnchors
from scene_experts.strategy.grow_points import GrowPoints
from scene_experts.training.config import check
from scene_experts.training.recipes import RECIPES
from support.graph_scenes import start_graph


def view(rows: list[int], opacity: list[float], radii: list[int]) -> tuple[Decoded, Render]:
    """A view of `rows`, those of positive opacity drawn with `radii`; every 2D gradient is (3, 4)."""
    raw = torch.tensor(opacity)[:, None]
    source, n = torch.tensor(rows)[raw[:, 0] > 0], int((raw > 0).sum())
    g = Gaussians(torch.zeros(n, 3), torch.zeros(n, 4), torch.zeros(n, 3), raw[raw > 0], torch.zeros(n, 3), source)
    picture = torch.zeros(2, 2)
    render = Render(
        picture[..., None].expand(2, 2, 3), picture, picture, torch.tensor(radii, dtype=torch.int32), torch.tensor([[3.0, 4]] * n)
    )
    return Decoded(g, torch.tensor(rows), raw, {}), render


@pytest.mark.parametrize(("visits", "seen"), [("drawn", [0, 0, 2, 0, 0]), ("seen", [2, 0, 2, 2, 0])])
def test_only_drawn_points_count_as_visited(visits, seen):
    scene = start_graph(torch.float32)
    growth = GrowPoints(start_stat=0, adjust=Every(1, 100, 10), visits=visits)
    for step in (1, 2):  # row 0 is hidden, row 2 drawn, row 3 misses the picture
        growth.observe(scene, *view([0, 2, 3], [-0.5, 0.25, 0.5], [4, 0]), step)
    stats = scene.table.stats
    assert stats["visits"][:5].tolist() == seen
    assert stats["count"][:5, 0].tolist() == [0, 0, 2, 0, 0] and stats["grad"][:5, 0].tolist() == [0, 0, 10, 0, 0]
    assert stats["opacity"][:5].tolist() == ([0, 0, 0.5, 0, 0] if visits == "drawn" else [0, 0, 0.5, 1, 0])


def test_points_found_new_ones_where_their_gaussians_are():
    scene = start_graph(torch.float32)
    growth = GrowPoints(start_stat=0, adjust=Every(1, 100, 10), elimination=False)
    scene.table.params["log_scaling"].data[:, :3] = 2.0  # offsets reach far
    growth.observe(scene, *view([5], [0.5], [4]), 1)
    scene.table.stats["count"][5], scene.table.stats["grad"][5] = 50, 50.0
    place, n = scene.slot_points(torch.tensor([5]), torch.tensor([5]))[0], len(scene.table)
    sizes = scene.table.params["log_scaling"].detach().clone()
    edit = growth.update(scene, 10, torch.Generator().manual_seed(0))
    assert edit is not None and 1 <= edit.grown <= 3 and edit.pruned == 0 and len(scene.table) == n + edit.grown
    for row, factor in zip(range(n, len(scene.table)), (16, 4, 1)):
        assert float((scene.table.facts["xyz"][row] - place).abs().max()) <= 0.5001 * factor * scene.voxel
        assert torch.equal(scene.table.params["feature"][row], scene.table.params["feature"][5])
    assert torch.equal(scene.table.params["log_scaling"][:n], sizes)  # nothing clamps them


def test_parts_of_another_method_are_refused():
    cfg = RECIPES["sags"][1]
    check(cfg)
    for wrong in (replace(cfg, growth=GrowAnchors()), replace(RECIPES["scaffold-gs"][1], growth=GrowPoints())):
        with pytest.raises(InputError):
            check(wrong)


def test_numbers_of_sags():
    growth = RECIPES["sags"][1].growth
    assert growth.cell_factors() == [16, 4, 1] and growth.gate() == 30 and growth.largest_log_size is None
    assert (growth.start_stat, growth.adjust, growth.min_opacity) == (500, Every(1500, 15_000, 100), 0.005)
