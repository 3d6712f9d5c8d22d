"""Growth on levels against a slow implementation of Octree-GS's rule, one slot at a time."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.table import Table
from scene_experts.scene.anchors.levels import Levels
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.scene.anchors.select import LevelSelector, Octree
from scene_experts.strategy import observe
from scene_experts.strategy.grow_octree import GrowOctree
from scene_experts.training.config import check
from scene_experts.training.recipes import RECIPES
from support.octree import slow_level

K, EDGE, COUNT = 4, 0.8, 4
CAMERAS = ((0.0, 0.0, -1.0), (2.0, 0.0, 4.0), (0.0, 5.0, 0.0))
LEVELS = Levels(COUNT, 1, 2, EDGE, (-2.0, -2.0, -2.0), 8.0, "round", 0.4, CAMERAS)
LATE = 10_001  # after the coarse phase


def make(n=320, empty: int | None = None) -> AnchorScene:
    """Random anchors on all levels but `empty`, with random statistics."""
    torch.manual_seed(0)
    rows = []
    for level in range(COUNT):
        cells = torch.unique(torch.randint(0, 5 * 2**level, (n // COUNT, 3)), dim=0)
        rows += [(level, cell) for cell in cells] if level != empty else []
    level, cell = torch.tensor([j for j, _ in rows]), torch.stack([c for _, c in rows])
    n = len(rows)
    xyz = torch.stack([LEVELS.positions(c[None], int(j))[0] for j, c in rows]).float()
    params = {"feature": torch.randn(n, 32), "offsets": torch.randn(n, K, 3), "log_scaling": torch.full((n, 6), math.log(0.4))}
    facts = {"cell": cell, "xyz": xyz, "level": level, "extra_level": torch.zeros(n)}
    scene = AnchorScene(Anchors(K=K, select=Octree()), Table(params, facts), LEVELS.size(COUNT - 1), 5.0, LevelSelector(Octree(), LEVELS))
    observe.start(scene.table, K)
    scene.table.stats["count"] = torch.randint(30, 60, (n, K)).float()
    scene.table.stats["grad"] = scene.table.stats["count"] * torch.rand(n, K) * 6e-4
    return scene


def slow_growth(scene: AnchorScene, refine: bool = True) -> dict[tuple[int, tuple[int, ...]], torch.Tensor]:
    """Return the expected new anchors: {(level, cell): feature}."""
    table, u, born = scene.table, 2**0.2, {}
    taken = {(int(j), tuple(c)) for j, c in zip(table.facts["level"], table.facts["cell"].tolist())}
    for level in range(COUNT):
        tau, upper = 2e-4 * u**level, 2e-4 * u ** (level + 1)
        fresh: dict[tuple[int, tuple[int, ...]], list[torch.Tensor]] = {}
        for a in (table.facts["level"] == level).nonzero().squeeze(1).tolist():
            for k in range(K):
                count = float(table.stats["count"][a, k])
                g = float(table.stats["grad"][a, k]) / count if count > 40 else 0.0
                if g < tau:
                    continue
                target = level if g < upper else level + 1
                if target > level and (not refine or target == COUNT or not any(j == target for j, _ in taken)):
                    continue
                point = table.facts["xyz"][a].double() + (table.params["offsets"][a, k] * table.params["log_scaling"][a, :3].exp()).double()
                size = EDGE / 2**target
                cell = tuple(math.floor((float(x.detach()) + 2.0) / size + 0.5) for x in point)
                centre = [c * size - 2.0 for c in cell]
                votes = sum(target <= min(max(round(slow_level(centre, target, c)), 0), COUNT - 1) for c in CAMERAS)
                if (target, cell) not in taken and votes / 3 > 0.4:
                    fresh.setdefault((target, cell), []).append(table.params["feature"][a].detach())
        for (target, cell), features in fresh.items():
            taken.add((target, cell))
            born[target, cell] = torch.stack(features).amax(0) if target == level else torch.zeros(32)
    return born


@pytest.mark.parametrize(("step", "empty"), [(LATE, None), (1600, None), (LATE, 2)])
def test_growth_founds_the_cells_of_the_slow_rule(step, empty):
    scene = make(empty=empty)
    n, refine = len(scene.table), step == LATE
    expected = slow_growth(make(empty=empty), refine)
    grown, capped = GrowOctree().grow(scene, torch.Generator(), step)
    found = scene.table
    born = {(int(found.facts["level"][i]), tuple(found.facts["cell"][i].tolist())): i for i in range(n, len(found))}
    assert born.keys() == expected.keys() and grown == len(expected) == len(found) - n > (20 if refine else 5) and not capped
    for (level, cell), i in born.items():
        assert torch.equal(found.params["feature"][i].detach(), expected[level, cell])
        assert float(found.params["log_scaling"][i, 0].detach()) == pytest.approx(math.log(EDGE / 2**level))
        torch.testing.assert_close(found.facts["xyz"][i], LEVELS.positions(torch.tensor([cell]), level)[0].float())
        assert not found.params["offsets"][i].any() and float(found.facts["extra_level"][i]) == 0
    assert (2 in found.facts["level"]) == (empty != 2)  # nothing is founded on an empty level


def test_growth_within_bounds_creates_anchors_near_the_box_alone():
    free, bound = make(), make()
    n = len(free.table)
    GrowOctree().grow(free, torch.Generator(), LATE)
    GrowOctree(bounds=(-9.0, -9.0, -9.0, 0.0, 9.0, 9.0)).grow(bound, torch.Generator(), LATE)
    new = lambda scene: scene.table.facts["xyz"][n:, 0]  # noqa: E731
    assert new(bound).max() <= EDGE < new(free).max() and 5 < len(new(bound)) < len(new(free))


def test_statistics_of_eligible_slots_begin_anew():
    scene = make()
    before = {k: v.clone() for k, v in scene.table.stats.items()}
    GrowOctree().grow(scene, torch.Generator(), LATE)
    n = len(before["count"])
    eligible = before["count"] > 40
    for name in ("grad", "count"):
        after = scene.table.stats[name]
        assert not after[:n][eligible].any() and torch.equal(after[:n][~eligible], before[name][~eligible]) and not after[n:].any()


def test_anchors_of_large_mean_gradient_ask_for_finer_levels():
    scene, n = make(), len(make().table)
    stats, expected = scene.table.stats, []
    for a in range(n):
        slots = [float(stats["grad"][a, k] / stats["count"][a, k]) for k in range(K) if float(stats["count"][a, k]) > 40]
        mean, level = sum(slots) / (len(slots) + 1e-6), int(scene.table.facts["level"][a])
        passed = [mean >= 0.25 * 2e-4 * 2 ** (0.2 * j) for j in range(COUNT)]
        expected.append(0.01 * passed[level])
    GrowOctree().grow(scene, torch.Generator(), LATE)
    assert 0 < sum(expected) < 0.01 * n
    torch.testing.assert_close(scene.table.facts["extra_level"][:n], torch.tensor(expected))


def test_finer_levels_wait_for_the_coarse_phase():
    calm, late = make(), make()
    GrowOctree().grow(calm, torch.Generator(), 1600)
    GrowOctree().grow(late, torch.Generator(), LATE)
    assert not calm.table.facts["extra_level"].any() and late.table.facts["extra_level"].any()


def test_the_cap_takes_the_strongest():
    scene = make()
    n = len(scene.table)
    grown, capped = GrowOctree().grow(scene, torch.Generator(), LATE, cap=n + 7)
    assert (grown, capped, len(scene.table)) == (7, True, n + 7)


def test_levels_and_growth_by_level_belong_together():
    octree, scaffold = RECIPES["octree-gs"][1], RECIPES["scaffold-gs"][1]
    check(octree)
    for cfg in (replace(octree, growth=scaffold.growth), replace(scaffold, growth=octree.growth)):
        with pytest.raises(InputError, match="levels"):
            check(cfg)
    with pytest.raises(InputError, match="update-ratio"):
        check_fields(GrowOctree(update_ratio=-1.0), "growth")


def test_the_published_schedule():
    octree = RECIPES["octree-gs"][1]
    assert octree.iterations == 40_000 and octree.scaled() == octree
    assert octree.growth.adjust.stop == 25_000 and octree.scene.select.coarse_until == 10_000
    short = replace(octree, iterations=4000).scaled()
    assert (short.growth.adjust.start, short.growth.adjust.stop, short.scene.select.coarse_until) == (150, 2500, 1000)
