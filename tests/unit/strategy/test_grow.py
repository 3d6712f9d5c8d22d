"""Growing and pruning against a slow implementation of Scaffold-GS's rule."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.schedule import Every
from scene_experts.core.table import Table
from scene_experts.geometry.voxel import coarsen
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.strategy import observe
from scene_experts.strategy.grow import GrowAnchors

VOXEL, K = 0.05, 4


def make(n=60, seed=0) -> AnchorScene:
    torch.manual_seed(seed)
    cells = torch.unique(torch.randint(-40, 40, (n, 3)), dim=0)
    n = len(cells)
    params = {"feature": torch.randn(n, 32), "offsets": torch.randn(n, K, 3), "log_scaling": torch.full((n, 6), math.log(0.4))}
    scene = AnchorScene(Anchors(K=K), Table(params, {"cell": cells, "xyz": (cells.double() * VOXEL).float()}), VOXEL, 5.0)
    observe.start(scene.table, K)
    scene.table.stats["count"] = torch.randint(30, 60, (n, K)).float()
    scene.table.stats["grad"] = scene.table.stats["count"] * torch.rand(n, K) * 1.2e-3
    return scene


def slow_growth(scene: AnchorScene, rule: GrowAnchors):
    """Return the expected new anchors, cell by cell: {cell in fine voxels: (level factor, feature)}."""
    table, born = scene.table, {}
    stats = table.stats
    taken = [tuple(c) for c in table.facts["cell"].tolist()]
    for level, factor in enumerate((16, 4, 1)):
        occupied = {tuple(coarsen(torch.tensor(c), factor).tolist()) for c in taken}
        fresh = {}
        for a in range(len(stats["visits"])):
            for k in range(K):
                count, g = float(stats["count"][a, k]), float(stats["grad"][a, k] / stats["count"][a, k])
                if count <= 40 or g < rule.grad_threshold * 2**level:
                    continue
                point = table.facts["xyz"][a].double() + (table.params["offsets"][a, k] * table.params["log_scaling"][a, :3].exp()).double()
                fine = (math.floor(float(x.detach()) / VOXEL + 0.5) for x in point)
                cell = tuple((2 * i + factor) // (2 * factor) for i in fine)
                if cell not in occupied:
                    fresh.setdefault(cell, []).append(table.params["feature"][a].detach())
        for cell, features in fresh.items():
            fine = tuple(c * factor for c in cell)
            taken.append(fine)
            born.setdefault(fine, []).append((factor, torch.stack(features).amax(0)))
    return born


def test_growth_within_bounds_keeps_the_candidates_inside():
    """With one level of single voxels, a cell is created inside exactly if it is created without bounds."""
    cells = lambda scene: {tuple(cell) for cell in scene.table.facts["cell"].tolist()}  # noqa: E731
    free, bound, start = make(), make(), cells(make())
    rule = GrowAnchors(elimination=False, levels=1, init_factor=1)
    rule.grow(free, torch.Generator())
    replace(rule, bounds=(-9.0, -9.0, -9.0, 0.0, 9.0, 9.0)).grow(bound, torch.Generator())
    assert cells(bound) - start == {cell for cell in cells(free) - start if cell[0] * VOXEL < -0.5 * VOXEL} | {
        cell
        for cell in cells(bound) - start
        if cell[0] == 0  # a cell that the side cuts
    }
    assert 5 < len(cells(bound) - start) < len(cells(free) - start)
    with pytest.raises(InputError, match=r"--growth\.bounds"):
        check_fields(GrowAnchors(bounds=(0.0, 0.0, 0.0, 1.0, 1.0, -1.0)), "growth")


def test_growth_founds_the_cells_of_the_slow_rule():
    scene, rule = make(), GrowAnchors(elimination=False)
    n, expected = len(scene.table), slow_growth(make(), GrowAnchors())
    grown, capped = rule.grow(scene, torch.Generator())
    assert grown == sum(len(v) for v in expected.values()) > 20 and not capped
    for row in range(n, n + grown):
        factor, feature = expected[tuple(scene.table.facts["cell"][row].tolist())].pop(0)
        assert torch.equal(scene.table.params["feature"][row], feature)
        torch.testing.assert_close(scene.table.params["log_scaling"][row], torch.full((6,), math.log(VOXEL * factor)))
        assert not scene.table.params["offsets"][row].any()
    torch.testing.assert_close(scene.table.facts["xyz"], (scene.table.facts["cell"].double() * VOXEL).float())


def test_statistics_restart_only_where_eligible():
    scene = make()
    count, grad = scene.table.stats["count"].clone(), scene.table.stats["grad"].clone()
    n = len(scene.table)
    GrowAnchors().grow(scene, torch.Generator().manual_seed(0))
    eligible = count > 40
    for name, before in (("count", count), ("grad", grad)):
        after = scene.table.stats[name][:n]
        assert not after[eligible].any() and torch.equal(after[~eligible], before[~eligible])
        assert not scene.table.stats[name][n:].any()


def test_thresholds_cells_and_keep_shares():
    assert GrowAnchors().cell_factors() == [16, 4, 1]
    assert GrowAnchors(init_factor=128).cell_factors() == [128, 32, 8]
    assert GrowAnchors(init_factor=4).cell_factors() == [4, 1]  # a factor of 0 would divide by zero
    scene = make(400)
    scene.table.stats["count"].fill_(50)
    scene.table.stats["grad"].fill_(50 * 3e-4)  # above the first threshold, below the second
    full = GrowAnchors(elimination=False, levels=1).grow(make_like(scene), torch.Generator())[0]
    some = GrowAnchors(levels=1).grow(make_like(scene), torch.Generator().manual_seed(1))[0]
    every_level = GrowAnchors(elimination=False).grow(make_like(scene), torch.Generator())[0]
    assert full == every_level and 0 < some < full


def make_like(scene: AnchorScene) -> AnchorScene:
    copy = make(400)
    copy.table.stats = {k: v.clone() for k, v in scene.table.stats.items()}
    return copy


def test_impossible_numbers_are_refused():
    for wrong, flag in (({"hierarchy_factor": 1}, "hierarchy-factor"), ({"init_factor": 0}, "init-factor"), ({"levels": 0}, "levels")):
        with pytest.raises(InputError, match=rf"--growth\.{flag}"):
            check_fields(GrowAnchors(**wrong), "growth")


def test_cap_holds_and_prefers_large_gradients():
    scene = make()
    cap = len(scene.table) + 5
    grown, capped = GrowAnchors(elimination=False).grow(scene, torch.Generator(), cap=cap)
    assert capped and grown == 5 and len(scene.table) == cap
    again, _ = GrowAnchors(elimination=False).grow(scene, torch.Generator(), cap=cap)
    assert again == 0


def test_runaway_offsets_found_nothing():
    scene = make()
    scene.table.params["offsets"].data[0] = 1e30
    scene.table.params["offsets"].data[1] = float("nan")
    GrowAnchors(elimination=False).grow(scene, torch.Generator())
    assert torch.isfinite(scene.table.facts["xyz"]).all() and scene.table.facts["xyz"].abs().max() < 100


def test_prune_removes_faint_well_seen_anchors_and_restarts_their_count():
    scene = make()
    stats, n = scene.table.stats, len(scene.table)
    stats["visits"].fill_(81)
    stats["opacity"].fill_(81 * 0.006)
    stats["opacity"][3] = 81 * 0.004  # faint
    stats["visits"][4], stats["opacity"][4] = 80, 0.0  # faint but not seen often enough
    fifth = scene.table.params["feature"][4].detach().clone()
    assert GrowAnchors().prune(scene) == 1
    assert len(scene.table) == n - 1 and torch.equal(scene.table.params["feature"][3], fifth)
    assert scene.table.stats["visits"][3] == 80 and scene.table.stats["visits"][0] == 0


def test_sizes_are_clamped_in_log_units():
    scene = make()
    scene.table.params["log_scaling"].data.fill_(9.0)
    GrowAnchors().prune(scene)
    values = scene.table.params["log_scaling"].detach()
    assert values[:, :3].min() == 9.0 and values[:, 3:].max() == pytest.approx(0.05)


def test_update_is_due_from_1600_and_frees_its_memory_at_the_end():
    rule = GrowAnchors(adjust=Every(1500, 15_000, 100))
    scene, generator = make(), torch.Generator().manual_seed(0)
    assert rule.update(scene, 1500, generator) is None and rule.update(scene, 1599, generator) is None
    edit = rule.update(scene, 1600, generator)
    assert edit is not None and edit.anchors == len(scene.table)
    assert rule.update(scene, 15_000, generator) is None and not scene.table.stats
    assert GrowAnchors(enabled=False).update(make(), 1600, generator) is None


def test_growth_leaves_networks_and_their_adam_state_alone():
    scene = make()
    groups = [{"params": p, "name": n} for n, p in scene.rate_groups().items()]
    optimizer = torch.optim.Adam(groups, lr=1e-3)
    scene.table.attach(optimizer)
    sum(p.square().sum() for g in optimizer.param_groups for p in g["params"]).backward()
    optimizer.step()
    networks = {k: v.detach().clone() for k, v in scene.network_tensors().items()}
    GrowAnchors(elimination=False).grow(scene, torch.Generator())
    GrowAnchors().prune(scene)
    for name, tensor in scene.network_tensors().items():
        assert torch.equal(tensor, networks[name]) and float(optimizer.state[tensor]["step"]) == 1


def test_the_anchors_miss_the_step_of_an_adjustment_even_without_a_change():
    scene = make()
    for name in ("count", "grad"):
        scene.table.stats[name].zero_()
    for p in scene.table.params.values():
        p.grad = torch.ones_like(p)
    rule = GrowAnchors()
    assert rule.update(scene, 1550, torch.Generator()) is None and all(p.grad is not None for p in scene.table.params.values())
    edit = rule.update(scene, 1600, torch.Generator())
    assert edit is not None and edit.grown == edit.pruned == 0
    assert all(p.grad is None for p in scene.table.params.values())
