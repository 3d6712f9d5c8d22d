"""Growth and removal by errors over several views, and masks of slots."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.schedule import Every
from scene_experts.core.types import Mode
from scene_experts.render import choose
from scene_experts.strategy import errors, observe
from scene_experts.strategy.control import AnchorControl
from scene_experts.strategy.grow import GrowAnchors
from scene_experts.strategy.grow_octree import GrowOctree
from scene_experts.strategy.survey import weigh_all
from support.scenes import CAMERA, start_scene
from support.surveys import make_survey


def rng():
    return torch.Generator().manual_seed(0)


def contributions_by_loop(scene, survey):
    most = torch.zeros(len(scene.table), scene.K)
    for view in survey.views:
        decoded, sums = survey.see(scene, view, 1, weigh_all)
        for place, value in zip(decoded.gaussians.source.tolist(), sums[:, 0].tolist()):
            a, k = divmod(place, scene.K)
            most[a, k] = max(float(most[a, k]), value)
    return most


def test_statistics_add_up_and_fade():
    scene, survey = start_scene("moe-gs"), make_survey(3, "auto")
    errors.observe_errors(scene, survey, 0, 0.7, 1, rng())
    stats = {name: value.clone() for name, value in scene.table.stats.items()}
    assert stats["looks"].max() == 3 and stats["covered"].sum() > 0 and (stats["wrong"] <= stats["covered"] + 1e-4).all()
    most = contributions_by_loop(scene, survey).sum(1)
    torch.testing.assert_close(stats["reach"], most, rtol=1e-4, atol=1e-4)  # all views have one camera
    errors.observe_errors(scene, survey, 0, 0.7, 1, rng())
    torch.testing.assert_close(scene.table.stats["covered"], 1.5 * stats["covered"], rtol=1e-4, atol=1e-4)
    assert torch.equal(scene.table.stats["looks"], 2 * stats["looks"])


def test_wrong_slots_and_unneeded_anchors():
    stats = {"covered": torch.tensor([[2.0, 2.0, 0.0]]), "wrong": torch.tensor([[0.7, 0.5, 0.0]])}
    assert errors.find_wrong(stats, 0.3).tolist() == [[True, False, False]]
    stats = {"looks": torch.tensor([7.0, 8.0, 9.0]), "reach": torch.tensor([0.1, 0.1, 2.0])}
    assert errors.find_unneeded(stats, 1.0).tolist() == [False, True, False]
    assert stats["looks"].tolist() == [7, 0, 0] and stats["reach"][0] > 0


@pytest.mark.parametrize(("recipe", "rule"), [("moe-gs", GrowAnchors), ("octree-gs", GrowOctree)])
def test_only_wrong_slots_create_anchors(recipe, rule):
    def grown(share, high):
        scene = start_scene(recipe)
        observe.start(scene.table, scene.K)
        stats = scene.table.stats
        stats["count"].fill_(60.0)
        stats["grad"].copy_(60 * 0.001 * torch.rand(stats["grad"].shape, generator=rng()))
        scene.table.params["offsets"].data.normal_(generator=rng())
        stats |= {"covered": torch.ones_like(stats["count"]), "wrong": torch.full_like(stats["count"], high)}
        return rule(error_views=2 if share else 0, error_share=share).grow(scene, rng(), 5000)[0]

    assert grown(0.5, 0.4) == 0 < grown(0.5, 0.6) == grown(0.0, 0.4)


def test_unneeded_anchors_are_removed():
    scene, rule = start_scene("scaffold-gs"), AnchorControl(error_views=2, least_contribution=1.0)
    observe.start(scene.table, scene.K)
    n = len(scene.table)
    scene.table.stats |= {"looks": torch.full((n,), 8.0), "reach": torch.arange(n).float()}
    assert rule.prune(scene) == 1 and len(scene.table) == n - 1 and not scene.table.stats["looks"].any()


@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs", "octree-gs", "sags"])
def test_masked_slots_are_not_drawn_and_anchors_without_others_go(recipe):
    scene, survey = start_scene(recipe), make_survey(2, "auto")
    before = scene(CAMERA, 1, Mode.DRAW, survey.draw.visible)
    most = contributions_by_loop(scene, survey)
    least = float(most[most > 0].median())
    rule = AnchorControl(mask_contribution=least, mask_at=(5,))
    rule.survey(scene, survey, 4, rng())
    assert rule.update(scene, 4, rng()) is None and "slots" not in scene.table.facts
    rule.survey(scene, survey, 5, rng())
    edit = rule.update(scene, 5, rng())
    alive = (most >= least).any(1)
    assert edit is not None and edit.pruned == int((~alive).sum()) > 0 and edit.anchors == len(scene.table) == int(alive.sum())
    assert "contribution" not in scene.table.stats
    if scene.K > 1:
        assert torch.equal(scene.table.facts["slots"], (most >= least)[alive])
    after = scene(CAMERA, 1, Mode.DRAW, survey.draw.visible)
    old = alive.nonzero().squeeze(1)[torch.div(after.gaussians.source, scene.K, rounding_mode="floor")] * scene.K
    kept = (most >= least).view(-1)[before.gaussians.source]
    if recipe != "sags":  # its graph changes with the points
        assert torch.equal(old + after.gaussians.source % scene.K, before.gaussians.source[kept])
    else:
        assert len(after.gaussians) > 0


def test_masks_in_every_decode_and_in_training():
    scene, cull = start_scene("moe-gs"), choose("auto", "cpu").visible
    scene.table.facts["slots"] = torch.rand(len(scene.table), scene.K, generator=rng()) < 0.5
    draws = [scene, scene.frozen(2000)]
    composed = start_scene("moe-gs")
    composed.load_state_dict(scene.state_dict())
    composed.config = replace(scene.config, decode="composed")
    composed.table.facts["slots"] = scene.table.facts["slots"]
    found = [d(CAMERA, 2000, Mode.DRAW, cull).gaussians for d in (*draws, composed)]
    assert scene.table.facts["slots"].view(-1)[found[0].source].all() and len(found[0]) > 0
    for g in found[1:]:
        assert torch.equal(g.source, found[0].source)
        torch.testing.assert_close(g.means, found[0].means, rtol=1e-4, atol=1e-5)
    for parameter in scene.parameters():
        parameter.requires_grad_()
    scene(CAMERA, 2000, Mode.TRAIN, cull).gaussians.opacities.sum().backward()
    assert all(p.grad.isfinite().all() for p in scene.parameters() if p.grad is not None)
    new = scene.new_rows(torch.tensor([[100, 100, 100]]), 0.1, torch.zeros(1, scene.config.F))
    scene.table.append(new)
    assert scene.table.facts["slots"][-1].all()


def test_settings():
    used = AnchorControl(mask_contribution=0.1, mask_at=(20_000,)).scaled(0.1)
    assert used.mask_at == (2000,)
    for bad in ({"error_quantile": 1.0}, {"least_contribution": 1.0}, {"mask_contribution": -1.0}, {"error_views": -1}):
        with pytest.raises(InputError, match="--growth"):
            check_fields(AnchorControl(**bad), "growth")
    assert not AnchorControl(adjust=Every(0, 10, 1)).grows_at(start_scene("scaffold-gs"), 5)
