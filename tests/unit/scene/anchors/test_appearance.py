"""Appearance codes: which view has which, and that the folded bias equals the longer input."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Camera, Mode, Points
from scene_experts.native import library as native
from scene_experts.scene.anchors.appearance import Codes, fold
from scene_experts.scene.anchors.mlp import HeadWeights
from scene_experts.training.recipes import RECIPES

CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32, id=3)
EVERYTHING = lambda means, scales, camera: torch.ones(len(means), dtype=torch.bool)  # noqa: E731


def scene(recipe="scaffold-gs", **changes):
    torch.manual_seed(0)
    points = Points(torch.rand(40, 3, dtype=torch.float64) + torch.tensor([0.0, 0, 3]), torch.zeros(40, 3, dtype=torch.uint8))
    cameras = [replace(CAMERA, id=i) for i in (1, 2, 3, 5)]
    made = replace(RECIPES[recipe][1].scene, appearance=32, **changes).start(points, 5.0, cameras)
    made.table.params["feature"].data.normal_()
    return made


def test_training_views_have_their_own_code_and_others_the_mean():
    codes = Codes(4, (1, 2, 3, 5))
    assert torch.equal(codes(replace(CAMERA, id=3)), codes.table[2])
    for other in (0, 4, 6, -1):
        torch.testing.assert_close(codes(replace(CAMERA, id=other)), codes.table.mean(0))


def test_a_folded_code_is_a_bias():
    torch.manual_seed(0)
    head = HeadWeights(None, None, torch.randn(2, 6, 9), torch.randn(2, 6), torch.randn(2, 3, 6), torch.randn(2, 3), None)
    code, x = torch.randn(4), torch.randn(7, 5)
    short = fold(head, code)
    long = torch.cat([x, code.expand(7, 4)], dim=1)
    for e in range(2):
        torch.testing.assert_close(x @ short.w1[e].T + short.b1[e], long @ head.w1[e].T + head.b1[e])


def test_colours_alone_depend_on_the_code_and_the_colour_network_has_the_counted_parameters():
    made = scene(decode="composed")
    assert sum(p.numel() for p in made.heads["color"].parameters()) == 3166  # type: ignore[attr-defined]
    assert made.rate_groups()["appearance"][0].shape == (4, 32)
    own, other = (made(replace(CAMERA, id=i), 1, Mode.TRAIN, EVERYTHING) for i in (3, 5))
    assert torch.equal(own.raw_opacity, other.raw_opacity) and not torch.allclose(own.gaussians.colors, other.gaussians.colors)
    rates = RECIPES["scaffold-gs"][1].rates
    assert rates.at("appearance", 30_000, 30_000, 5.0) == pytest.approx(5e-4) and rates.appearance.first == 0.05


@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs"])
@pytest.mark.skipif(native.load() is None, reason="the native library is not built here")
def test_native_and_composed_decode_agree_with_codes(recipe):
    found = []
    for decode in ("native", "composed"):
        made = scene(recipe, decode=decode)
        d = made(CAMERA, 2000, Mode.TRAIN, EVERYTHING)
        torch.manual_seed(1)
        (d.gaussians.colors * torch.randn_like(d.gaussians.colors)).sum().backward()
        grads = [made.codes.table.grad, made.table.params["feature"].grad, made.heads["color"].network_parameters()[0].grad]
        found.append((d.gaussians.colors.detach(), grads))
    (c1, g1), (c2, g2) = found
    torch.testing.assert_close(c1, c2, rtol=1e-4, atol=1e-5)
    for a, b in zip(g1, g2):
        torch.testing.assert_close(a, b, rtol=1e-3, atol=1e-5)
    assert g1[0][2].any() and not g1[0][0].any()  # only the code of the view


def test_a_checkpoint_remembers_which_views_have_codes():
    made = scene()
    again = replace(RECIPES["scaffold-gs"][1].scene, appearance=32).load(made.table, made.meta())
    assert made.meta()["views"] == [1, 2, 3, 5] and again.codes.views == (1, 2, 3, 5)
