"""Routers by their formulas, chosen by a flag, and a router of another package in the fused decode."""

from dataclasses import dataclass, replace

import pytest
import torch
from torch import nn
from torch.nn import functional

from scene_experts.arguments.parse import Command, parse
from scene_experts.commands.train import TrainCommand
from scene_experts.core.errors import InputError
from scene_experts.core.parts import register
from scene_experts.core.types import Mode, Routing
from scene_experts.scene.anchors.balance import Balanced
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.scene.anchors.places import Places
from scene_experts.scene.anchors.routers import Linear, Margin, Router, RouterModule, top_k
from scene_experts.training.config import find_unused
from scene_experts.training.recipes import RECIPES
from support.scenes import CAMERA, start_scene

A, F = 50, 32
SPARSE = 1501  # the first Top-k iteration


@register
@dataclass(frozen=True)
class CosineOfTest(Router):
    """Cosines between features and keys, as a researcher would add them. The weights of the chosen do not sum to 1."""

    name = "cosine-of-test"
    sums_to_one = False

    sharpness: float = 4.0
    """Factor of the cosines."""

    def build(self, experts, feature):
        return CosineModule(experts, feature, self.sharpness)


class CosineModule(RouterModule):
    def __init__(self, experts, feature, sharpness):
        super().__init__()
        self.keys, self.sharpness = nn.Parameter(torch.randn(experts, feature)), sharpness

    def forward(self, feature, position, k, mode=Mode.DRAW):
        logits = self.sharpness * functional.normalize(feature + 0.1, dim=1) @ functional.normalize(self.keys, dim=1).T
        gates = logits.softmax(dim=1)
        chosen = None if k is None else top_k(logits, k)
        return Routing(gates, chosen), gates if chosen is None else gates.gather(1, chosen)


def built(router: Router, experts: int = 5):
    torch.manual_seed(1)
    return router.build(experts, F).double()


def features(n: int = A):
    torch.manual_seed(2)
    return torch.randn(n, F, dtype=torch.float64)


def test_ties_go_to_the_lowest_index():
    assert top_k(torch.zeros(3, 5), 2).tolist() == [[0, 1]] * 3
    assert top_k(torch.tensor([[0.0, 2.0, 1.0, 2.0]]), 3).tolist() == [[1, 3, 2]]


def test_a_linear_router_may_see_positions():
    made, f, x = built(Linear(input_pos=True)), features(), torch.randn(A, 3, dtype=torch.float64)
    assert made.w.shape == (5, F + 3)
    with pytest.raises(ValueError, match="input_pos"):
        made(f, None, 2)
    torch.testing.assert_close(made(f, x, None)[1], torch.softmax(torch.cat([f, x], 1) @ made.w.T + made.b, 1))


@pytest.mark.parametrize("k", [1, 2, 4])
def test_margin_weights_as_written(k):
    routing, w = built(Margin())(features(), None, k)
    for a in range(A):
        g = sorted(routing.gates[a].tolist(), reverse=True)
        margins = [value - g[k] + 1e-4 for value in g[:k]]
        torch.testing.assert_close(w[a], torch.tensor([m / sum(margins) for m in margins], dtype=w.dtype))


def test_margin_weights_have_no_jump():
    """Where two experts swap ranks at the edge of Top-k, the weights on both sides agree; with softmax weights they do not."""
    jump = {}
    for router in (Linear(), Margin()):
        made, f = built(router), features()
        w, b = torch.zeros(5, F, dtype=torch.float64), torch.tensor([3.0, 1.0, 1.0, -1.0, -1.0], dtype=torch.float64)
        w[1, 0], w[2, 0] = 1.0, -1.0
        made.w.data, made.b.data = w, b
        sides = []
        for shift in (1e-7, -1e-7):
            f = f.clone()
            f[:, 0] = shift
            routing, weight = made(f, None, 2)
            sides.append(torch.zeros(A, 5, dtype=torch.float64).scatter(1, routing.chosen, weight))
        jump[router.name] = float((sides[0] - sides[1]).detach().abs().max())
    assert jump["margin"] < 1e-3 < 1e-2 < jump["linear"]


@pytest.mark.parametrize("router", [Margin(), CosineOfTest()])
def test_gradients_against_finite_differences(router):
    made, f = built(router), features(4).requires_grad_()
    assert torch.autograd.gradcheck(lambda feature: made(feature, None, 2)[1], (f,), eps=1e-7, atol=1e-5)


def everything(means, scales, camera):
    return torch.ones(len(means), dtype=torch.bool)


def scene_with(router: Router, decode: str, top_k: int | None = 2):
    recipe = RECIPES["moe-gs"][1]
    decoder = replace(recipe.scene.decoder, router=router, top_k=top_k)
    made = start_scene(replace(recipe, scene=replace(recipe.scene, decoder=decoder, decode=decode)))
    torch.manual_seed(3)
    nn.init.normal_(made.table.params["feature"])
    nn.init.normal_(made.table.params["offsets"])
    return made


def losses(made, step):
    """A loss that reaches every output, and the gradients of every parameter."""
    decoded = made(CAMERA, step, Mode.TRAIN, everything)
    torch.manual_seed(4)
    total = sum((value * torch.randn_like(value)).sum() for name, value in vars(decoded.gaussians).items() if name != "source")
    total = total + sum((r.gates.square().sum() for r in decoded.routing.values()), start=0.1 * decoded.raw_opacity.sum())
    total.backward()
    return decoded, {n: p.grad for n, p in {**made.table.params, **made.network_tensors()}.items() if p.grad is not None}


@pytest.mark.parametrize("router", [Linear(), Linear(input_pos=True), Margin(), Balanced(), CosineOfTest()])
@pytest.mark.parametrize(("step", "k"), [(1, 2), (SPARSE, 1), (SPARSE, 2), (SPARSE, 5)])
def test_the_fused_decode_with_any_router_is_the_composed_one(router, step, k):
    found = {}
    for decode in ("composed", "native"):
        found[decode] = losses(scene_with(router, decode, k), step)
    (a, da), (b, db) = found["composed"], found["native"]
    assert len(a.gaussians) == len(b.gaussians) > 100 and da.keys() == db.keys()
    for name, value in vars(a.gaussians).items():
        torch.testing.assert_close(getattr(b.gaussians, name), value, rtol=1e-4, atol=1e-5)
    for name, value in da.items():
        torch.testing.assert_close(db[name], value, rtol=1e-3, atol=2e-4 * max(1.0, float(value.abs().max())), msg=name)
    assert all(torch.equal(a.routing[n].chosen, b.routing[n].chosen) for n in ATTRIBUTES) if step > 1 else True


@pytest.mark.parametrize("step", [1, SPARSE])
def test_a_frozen_scene_draws_what_the_decode_draws(step):
    made = scene_with(CosineOfTest(), "auto")
    with torch.no_grad():
        slow, fast = made(CAMERA, step, Mode.DRAW, everything), made.frozen(step)(CAMERA, step, Mode.DRAW, everything)
    for name, value in vars(slow.gaussians).items():
        assert torch.equal(getattr(fast.gaussians, name), value), name


def test_experts_that_do_not_exist_are_refused():
    made = scene_with(CosineOfTest(), "auto")
    made.heads["cov"].router.forward = lambda f, position, k, mode: (Routing(f, torch.full((len(f), 2), 7)), f[:, :2])
    with pytest.raises(IndexError, match="experts from 0 to 4"):
        made(CAMERA, SPARSE, Mode.DRAW, everything)


def chosen_by(*flags: str, recipe: str = "moe-gs") -> Experts:
    command = Command("train", defaults={"cfg": RECIPES[recipe][1]})
    return parse(TrainCommand, command, ["--data", "c", "--out", "r", *flags]).cfg.scene.decoder


def test_a_flag_chooses_the_router():
    assert chosen_by().router == Linear()
    assert chosen_by("--scene.decoder.router", "margin").router == Margin()
    assert chosen_by("--scene.decoder.router=balanced", "--scene.decoder.router.speed", "0.01").router == Balanced(speed=0.01)
    assert chosen_by("--scene.decoder.router.sharpness", "9", "--scene.decoder.router", "cosine-of-test").router == CosineOfTest(9.0)
    assert chosen_by("--scene.decoder.router", "margin", recipe="moe-gs-posrouter").router == Margin(input_pos=True)  # a setting of both
    assert chosen_by("--scene.decoder.router", "places", recipe="scene-experts").router == Places()
    with pytest.raises(InputError, match=r"linear, margin.*found 'cosin'"):
        chosen_by("--scene.decoder.router", "cosin")
    with pytest.raises(InputError, match=r"speed; it belongs to --scene.decoder.router balanced$"):
        chosen_by("--scene.decoder.router.speed", "0.01")  # a linear router has none


def test_training_says_which_decode_runs():
    assert scene_with(Linear(), "auto").describe_decode(1) == "fused (compiled)"
    assert "routed in torch (opacity, cov, color" in scene_with(CosineOfTest(), "auto").describe_decode(1)
    assert "--scene.decode composed" in scene_with(Linear(), "composed").describe_decode(1)


def test_a_router_among_one_expert_has_no_effect_and_is_named():
    train = RECIPES["moe-gs"][1]
    alone = replace(train, scene=replace(train.scene, decoder=Experts(num=1, top_k=None, router=Margin())))
    assert "--scene.decoder.router" in find_unused(alone) and "--loss.load" in find_unused(alone)
    assert find_unused(replace(train, scene=replace(train.scene, decoder=Experts(router=Margin())))) == []
