"""The feature bank against its formula, one anchor at a time."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Mode, Points
from scene_experts.scene.anchors.features import Bank, FeatureBank, OwnFeature
from scene_experts.training.recipes import RECIPES

CAMERA = Camera(torch.eye(4), torch.tensor([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]]), 48, 32)
EVERYTHING = lambda means, scales, camera: torch.ones(len(means), dtype=torch.bool)  # noqa: E731


def scene(recipe="scaffold-gs-bank", **changes):
    torch.manual_seed(0)
    points = Points(torch.rand(40, 3, dtype=torch.float64) + torch.tensor([0.0, 0, 3]), torch.zeros(40, 3, dtype=torch.uint8))
    made = replace(RECIPES[recipe][1].scene, **changes).start(points, 5.0)
    made.table.params["feature"].data.normal_()
    return made


def test_the_blend_follows_the_formula():
    torch.manual_seed(0)
    bank, table = Bank(32), Table({"feature": torch.randn(5, 8)}, {"xyz": torch.zeros(5, 3)})
    rows, direction, distance = torch.tensor([3, 1]), torch.randn(2, 3), torch.rand(2, 1)
    out = bank(table, rows, direction, distance)
    for i, row in enumerate(rows.tolist()):
        f = table.params["feature"][row]
        hidden = torch.relu(bank.w1[0] @ torch.cat([direction[i], distance[i]]) + bank.b1[0])
        w = torch.softmax(bank.w2[0] @ hidden + bank.b2[0], dim=0)
        quarter = [f[4 * (j % 2)] for j in range(8)]  # f[::4] has 2 values, repeated as a whole
        half = [f[2 * (j % 4)] for j in range(8)]
        for j in range(8):
            torch.testing.assert_close(out[i, j], w[0] * quarter[j] + w[1] * half[j] + w[2] * f[j])


def test_gradients_of_the_blend():
    torch.manual_seed(1)
    bank, table = Bank(4).double(), Table({"feature": torch.randn(3, 4, dtype=torch.float64)}, {})
    direction, distance = torch.randn(3, 3, dtype=torch.float64), torch.rand(3, 1, dtype=torch.float64)
    rows = torch.arange(3)

    def blended(feature, w1, b2):
        return torch.func.functional_call(
            bank, {"w1": w1, "b2": b2}, (type("T", (), {"params": {"feature": feature}}), rows, direction, distance)
        )

    inputs = (table.params["feature"], bank.w1, bank.b2)
    assert torch.autograd.gradcheck(blended, inputs)


def test_parameters_and_rates():
    made = scene()
    assert sum(p.numel() for p in made.rate_groups()["mix"]) == 4 * 32 + 32 + 32 * 3 + 3 == 259
    assert sum(t.numel() for t in made.network_tensors().values()) == 7086 + 259
    rates = RECIPES["scaffold-gs-bank"][1].rates
    assert rates.at("mix", 30_000, 30_000, 5.0) == pytest.approx(1e-5) and rates.mix.first == 0.01


def test_decoders_see_the_blend_and_routers_the_raw_feature():
    made = scene("moe-gs", mix=FeatureBank())
    decoded = made(CAMERA, 2000, Mode.TRAIN, EVERYTHING)
    again = made.routing(2000)["color"].chosen
    assert torch.equal(decoded.routing["color"].chosen, again[decoded.rows])
    before = decoded.raw_opacity
    with torch.no_grad():
        made.bank.b2 += torch.tensor([[3.0, 0.0, 0.0]])
    after = made(CAMERA, 2000, Mode.TRAIN, EVERYTHING)
    assert not torch.allclose(before, after.raw_opacity) and torch.equal(after.routing["color"].chosen, decoded.routing["color"].chosen)


def test_features_must_be_cut_in_four():
    FeatureBank().check_size(32)
    OwnFeature().check_size(33)
    with pytest.raises(InputError, match=r"--scene\.F"):
        FeatureBank().check_size(30)
    assert OwnFeature().width(7) == 7 and OwnFeature().build(7) is None and FeatureBank().width(8) == 8
