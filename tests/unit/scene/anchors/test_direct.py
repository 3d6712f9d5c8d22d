"""Where the tensors of the kernels lie, and which networks need autograd. Whole views are compared in training/test_direct.py."""

from dataclasses import replace

import torch
from torch import nn

from scene_experts.core.types import Mode
from scene_experts.scene.anchors.direct import DirectAnchors, Own, explain_uncovered
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.scene.anchors.places import Places
from scene_experts.scene.anchors.routers import Margin
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.training.recipes import RECIPES
from support.scenes import start_scene


def start_anchors(config):
    return start_scene(replace(RECIPES["scaffold-gs"][1], scene=config))


def weights(scene, step):
    return {a: scene.heads[a].weights(step) for a in ATTRIBUTES}


def test_a_tensor_is_found_in_its_parameter():
    p = nn.Parameter(torch.randn(5, 3, 2))
    assert Own.of(p) == Own(p, 0, 5) and Own(p, 0, 5).whole
    part = Own.of(p[2:4])
    assert part == Own(p, 2, 2) and not part.whole
    assert torch.equal(part.of_whole(torch.arange(5)), torch.tensor([2, 3]))
    assert Own.of(p + 0) is None and Own.of(p[:, :1]) is None, "computed, or not leading entries"


def test_networks_that_need_autograd_are_named():
    plain = start_anchors(Anchors())
    assert explain_uncovered(weights(plain, 1)) == ""
    computed = weights(plain, 1)
    computed["cov"] = replace(computed["cov"], w1=computed["cov"].w1 * 2)
    assert "computed" in explain_uncovered(computed)
    routed = start_anchors(Anchors(decoder=Experts(num=3, warmup=0, router=Margin())))
    assert "router of opacity" in explain_uncovered(weights(routed, 1))
    assert isinstance(plain.direct(1, load=False), DirectAnchors)
    assert "phases" in refuse(plain)


def refuse(scene):
    scene.heads["color"].in_two_phases = False
    found = scene.direct(1, load=False)
    del scene.heads["color"].in_two_phases
    return found


def test_parts_of_parameters_get_the_gradient_of_the_whole():
    scene = start_anchors(Anchors(decoder=Experts(num=3, warmup=10, router=Places())))
    alone, placed = (DirectAnchors(scene, weights(scene, step), load=False) for step in (1, 11))
    assert alone.nets.EM == 1 and placed.nets.EM == 3
    for made in (alone, placed):
        shapes = {id(p): p.shape for p in scene.parameters() if p.requires_grad}
        assert {id(p): g.shape for p, g in made.grads.pairs} == shapes
    assert len(alone.moves[0]) == 12 and not placed.moves[0]


def test_the_choice_of_rows_and_the_finish_make_up_a_view():
    scene = start_anchors(Anchors())
    assert not scene.changes_drawn
    scene.table.facts["slots"] = torch.ones(len(scene.table), scene.K, dtype=torch.bool)
    assert scene.changes_drawn and Mode.TRAIN
