"""Experts for places: one network first, then copies of it, each for the anchors nearest to its centre."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.scene.anchors.experts import Router
from scene_experts.scene.anchors.local import LocalExperts, LocalHead, find_centres
from scene_experts.scene.anchors.scene import ATTRIBUTES
from scene_experts.training.config import check
from scene_experts.training.recipes import RECIPES
from support.scenes import CAMERA, start_scene

WARM = 10_000  # the last iteration of one network
EXPERTS = 5
NONE = lambda p: []  # noqa: E731


def everything(means, scales, camera):
    return torch.ones(len(means), dtype=torch.bool)


def scene(decode: str = "auto"):
    made = start_scene("scene-experts")
    made.config = replace(made.config, decode=decode)
    torch.nn.init.normal_(made.table.params["feature"])
    return made


def split(made, companions=NONE):
    made.begin_iteration(WARM, WARM + 1, companions)
    return made


def drawn(made, step):
    with torch.no_grad():
        return made(CAMERA, step, Mode.DRAW, everything)


@pytest.mark.parametrize("decode", ["composed", "native"])
def test_the_split_does_not_change_the_gaussians(decode):
    made = scene(decode)
    before = drawn(made, WARM)
    after = drawn(split(made), WARM + 1)
    for name, value in vars(before.gaussians).items():
        torch.testing.assert_close(getattr(after.gaussians, name), value, rtol=0, atol=1e-6)
    assert set(after.routing) == set(ATTRIBUTES)


def test_the_native_decode_agrees_with_the_reference_after_the_experts_have_parted():
    made = split(scene())
    with torch.no_grad():
        for head in made.heads.values():
            head.w2.add_(0.1 * torch.randn_like(head.w2))
    native = drawn(made, WARM + 1)
    made.config = replace(made.config, decode="composed")
    composed = drawn(made, WARM + 1)
    assert len(native.gaussians) == len(composed.gaussians) > 100
    for name, value in vars(composed.gaussians).items():
        torch.testing.assert_close(getattr(native.gaussians, name), value, rtol=1e-4, atol=1e-5)
    assert all(torch.equal(native.routing[a].chosen, composed.routing[a].chosen) for a in ATTRIBUTES)


@pytest.mark.parametrize("decode", ["composed", "native"])
def test_only_the_first_expert_learns_before_the_split(decode):
    made = scene(decode)
    made(CAMERA, WARM, Mode.TRAIN, everything).gaussians.colors.sum().backward()
    head = made.heads["color"]
    assert head.w1.grad[0].any() and not head.w1.grad[1:].any() and head.router_w.grad is None


def test_each_expert_learns_from_its_own_anchors_after_the_split():
    made = split(scene())
    chosen = made.routing(WARM + 1)["color"].chosen
    rows = (chosen[:, 0] == 3).nonzero().squeeze(1)
    assert len(rows)
    made.decode(rows, CAMERA, WARM + 1, Mode.TRAIN).gaussians.colors.sum().backward()
    grad = made.heads["color"].w1.grad
    assert grad[3].any() and not grad[[i for i in range(EXPERTS) if i != 3]].any()


def test_an_anchor_has_the_expert_of_the_nearest_centre():
    made = split(scene())
    x = made.table.facts["xyz"] / made.extent
    centres, _ = find_centres(x, EXPERTS)
    nearest = torch.cdist(x.double(), centres).argmin(1)
    assert all(torch.equal(r.chosen[:, 0], nearest) for r in made.routing(WARM + 1).values())
    assert nearest.bincount(minlength=EXPERTS).min() > 0


def test_moments_and_averages_are_copied_too():
    made, held, routers = scene(), {}, {}
    for head in made.heads.values():
        for p in (head.w1, head.b1, head.w2, head.b2):
            held[id(p)] = [torch.randn_like(p), torch.randn_like(p)]
        routers |= {id(p): (p, torch.zeros_like(p)) for p in (head.router_w, head.router_b)}
    first = {key: [t[0].clone() for t in tensors] for key, tensors in held.items()}
    split(made, lambda p: held[id(p)] if id(p) in held else [routers[id(p)][1]])
    for key, tensors in held.items():
        assert all(torch.equal(t, f.expand_as(t)) for t, f in zip(tensors, first[key]))
    assert all(average.any() and torch.equal(p, average) for p, average in routers.values())


def test_other_iterations_change_nothing():
    made = scene()
    old = {name: t.clone() for name, t in made.network_tensors().items()}
    for before, step in ((0, 1), (WARM - 1, WARM), (WARM + 1, WARM + 2), (WARM - 4, WARM), (29_999, 30_000)):
        made.begin_iteration(before, step, NONE)
    assert all(torch.equal(t, old[name]) for name, t in made.network_tensors().items())


def test_a_batch_may_step_over_the_end_of_the_warm_up():
    made = scene()
    made.begin_iteration(WARM - 1, WARM + 3, NONE)
    assert made.heads["cov"].router_w.any()


def test_routing_is_that_of_one_expert_before_the_split():
    routing = scene().routing(5)["cov"]
    assert routing.chosen is None and (routing.gates[:, 0] == 1).all() and (routing.gates[:, 1:] == 0).all()


def test_centres_of_separate_groups_are_their_means():
    torch.manual_seed(1)
    wanted = torch.tensor([[0.0, 0, 0], [10, 0, 0], [0, 10, 0]], dtype=torch.float64)
    x = torch.cat([c + 0.1 * torch.randn(400, 3, dtype=torch.float64) for c in wanted])
    centres, spread = find_centres(x, 3)
    assert torch.cdist(wanted, centres).amin(1).max() < 0.05 and 0.01 < spread < 0.05


def test_far_points_do_not_take_a_centre():
    torch.manual_seed(2)
    x = torch.cat([torch.rand(990, 3), 1e4 * torch.rand(10, 3)])
    assert find_centres(x, 4)[0].abs().max() < 1.5


def test_every_centre_has_its_share_beside_a_dense_cluster():
    torch.manual_seed(3)
    x = torch.cat([0.1 * torch.randn(900, 3), 3.0 * torch.randn(100, 3)])
    centres, _ = find_centres(x, 8)
    assert torch.cdist(x.double(), centres).argmin(1).bincount(minlength=8).min() >= 10


@pytest.mark.parametrize("n", [1, 3, 8])
def test_fewer_positions_than_centres(n):
    centres, spread = find_centres(torch.rand(n, 3), 8)
    assert centres.shape == (8, 3) and centres.isfinite().all() and spread > 0


def test_a_scene_that_lost_all_its_anchors_is_split_without_places():
    made = scene()
    for head in made.heads.values():
        head.begin(WARM, WARM + 1, lambda: torch.zeros(0, 3), NONE)
        assert torch.equal(head.w1, head.w1[:1].expand_as(head.w1)) and not head.router_w.any()


def test_invalid_settings_are_refused():
    check(RECIPES["scene-experts"][1])
    with pytest.raises(InputError, match="positions"):
        LocalExperts(router=Router()).check()
    with pytest.raises(InputError, match="shared"):
        LocalExperts(shared=True).check()


def test_the_first_weights_are_those_of_one_network_with_any_variance():
    first = []
    for how in ("independent", "variance"):
        torch.manual_seed(0)
        first.append(LocalExperts(expert_init=how).build("color", 35, 16, 30, 32).state_dict())
    assert all(torch.equal(value, first[1][name]) for name, value in first[0].items())


def test_the_heads_are_local():
    assert all(isinstance(head, LocalHead) for head in scene().heads.values())
