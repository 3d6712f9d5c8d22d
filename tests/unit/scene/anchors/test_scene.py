"""Anchors to Gaussians against the paper's formulas, one Gaussian at a time."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.core.types import Camera, Mode, Points
from scene_experts.native import library as native
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.rates import Rates
from scene_experts.scene.anchors.scene import ATTRIBUTES, Anchors, AnchorScene
from scene_experts.training.recipes import RECIPES
from support.messages import naming

EVERYTHING = lambda means, scales, camera: torch.ones(len(means), dtype=torch.bool)  # noqa: E731


def camera() -> Camera:
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.1, -0.2, 6.0])
    return Camera(pose, torch.tensor([[80.0, 0, 40], [0, 80, 30], [0, 0, 1]]), 80, 60)


def scene(config: Anchors, n=200, seed=0) -> AnchorScene:
    torch.manual_seed(seed)
    xyz = torch.rand(n, 3, dtype=torch.float64) * 2 - 1
    made = AnchorScene.from_points(replace(config, voxel_size=0.01), Points(xyz, torch.zeros(n, 3, dtype=torch.uint8)), 5.0)
    for parameter, spread in (("feature", 1.0), ("offsets", 0.5)):
        made.table.params[parameter].data.normal_(0, spread)
    return made


def test_initial_anchors_sit_on_the_lattice_one_per_voxel():
    points = torch.tensor([[0.0, 0, 0], [0.004, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0]], dtype=torch.float64)
    made = AnchorScene.from_points(Anchors(voxel_size=0.01), Points(points, torch.zeros(4, 3, dtype=torch.uint8)), 5.0)
    assert sorted(made.table.facts["cell"].tolist()) == [[0, 0, 0], [0, 20, 0], [10, 0, 0]]
    torch.testing.assert_close(made.table.facts["xyz"], made.table.facts["cell"] * 0.01)
    assert not made.table.params["feature"].any() and not made.table.params["offsets"].any()
    with pytest.raises(InputError, match="--init random"):
        AnchorScene.from_points(Anchors(), Points(points[:0], torch.zeros(0, 3, dtype=torch.uint8)), 5.0)


def test_a_chosen_voxel_that_keeps_nearly_every_point_is_said(caplog):
    points = Points(
        torch.rand(100, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)), torch.zeros(100, 3, dtype=torch.uint8)
    )
    for config, said in ((Anchors(), False), (Anchors(voxel_size=0.3), False), (Anchors(voxel_size=1e-5), True)):
        caplog.clear()
        AnchorScene.from_points(config, points, 5.0)
        assert ("100 of 100" in caplog.text) == said


@pytest.mark.parametrize("add_dist", [(), ATTRIBUTES])
def test_every_gaussian_follows_the_formula(add_dist):
    made, cam = scene(Anchors(add_dist=add_dist, decode="composed"), n=20), camera()
    decoded = made(cam, 1, Mode.TRAIN, EVERYTHING)
    g, p = decoded.gaussians, made.table.params
    centre = -cam.world_to_cam[:3, :3].T @ cam.world_to_cam[:3, 3]
    order = []
    for row in decoded.rows.tolist():
        x, f = made.table.facts["xyz"][row], p["feature"][row]
        v = x - centre
        z = lambda a, f=f, v=v: torch.cat([f, v / v.norm()] + ([v.norm()[None]] if a in add_dist else []))  # noqa: E731
        out = {}
        for a in ATTRIBUTES:
            w = made.heads[a].weights(1)
            out[a] = w.w2[0] @ torch.relu(w.w1[0] @ z(a) + w.b1[0]) + w.b2[0]
        for k in range(10):
            sigma = torch.tanh(out["opacity"][k])  # eq. 1
            if sigma <= 0:
                continue
            i = len(order)
            order.append(row * 10 + k)
            cov = out["cov"][7 * k : 7 * k + 7]
            s = p["log_scaling"][row].exp()
            torch.testing.assert_close(g.opacities[i], sigma)
            torch.testing.assert_close(g.means[i], x + p["offsets"][row, k] * s[:3])  # eq. 2
            torch.testing.assert_close(g.scales[i], s[3:] * torch.sigmoid(cov[:3]))
            torch.testing.assert_close(g.quats[i], cov[3:] / cov[3:].norm())
            torch.testing.assert_close(g.colors[i], torch.sigmoid(out["color"][3 * k : 3 * k + 3]))
    assert g.source.tolist() == order and len(order) > 20
    assert decoded.raw_opacity.shape == (len(decoded.rows), 10)


@pytest.mark.parametrize(
    "name", ["scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-e4-top1", "moe-gs-e3-dense", "scaffold-gs-depth4", "moe-gs-posrouter"]
)
@pytest.mark.parametrize("step", [1, 1501])
@pytest.mark.skipif(native.load() is None, reason="the native library is not built here")
def test_native_and_composed_decode_agree_in_value_and_gradient(name, step):
    found = []
    for decode in ("auto", "composed"):
        made = scene(replace(RECIPES[name][1].scene, decode=decode))
        d = made(camera(), step, Mode.TRAIN, EVERYTHING)
        g = d.gaussians
        values = [g.means, g.quats, g.scales, g.opacities, g.colors, d.raw_opacity, *(r.gates for r in d.routing.values())]
        torch.manual_seed(3)
        sum((v * torch.randn_like(v)).sum() for v in values).backward()
        grads = [made.table.params[k].grad for k in made.table.params] + [t.grad for t in made.network_tensors().values()]
        found.append((g.source, [v.detach() for v in values], grads))
    (s1, v1, g1), (s2, v2, g2) = found
    assert torch.equal(s1, s2)
    for a, b in zip(v1, v2):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-5)
    for a, b in zip(g1, g2):
        assert (
            (a is None or not a.any())
            if b is None
            else torch.linalg.norm((torch.zeros_like(b) if a is None else a) - b) <= 1e-4 * (torch.linalg.norm(b) + 1e-6)
        )


def test_nothing_in_view_and_nothing_positive():
    made = scene(Anchors(decode="composed"))
    none = made(camera(), 1, True, lambda m, s, c: torch.zeros(len(m), dtype=torch.bool))
    assert len(none.gaussians) == 0 and none.raw_opacity.shape == (0, 10)
    with torch.no_grad():
        made.heads["opacity"].w2.zero_()
        made.heads["opacity"].b2.fill_(-1.0)
    faint = made(camera(), 1, Mode.TRAIN, EVERYTHING)
    assert len(faint.gaussians) == 0 and faint.raw_opacity.shape == (200, 10)


def test_a_camera_on_an_anchor_stays_finite():
    made = scene(Anchors(decode="composed"), n=3)
    pose = torch.eye(4)
    pose[:3, 3] = -made.table.facts["xyz"][0]
    decoded = made(replace(camera(), world_to_cam=pose), 1, Mode.TRAIN, EVERYTHING)
    decoded.raw_opacity.sum().backward()
    assert torch.isfinite(decoded.raw_opacity).all() and torch.isfinite(made.table.params["feature"].grad).all()


def test_rates_by_group():
    made = scene(RECIPES["moe-gs"][1].scene, n=4)
    groups, rates = made.rate_groups(), Rates(router_scale=0.5)
    assert list(groups) == ["feature", "offsets", "log_scaling", "opacity", "opacity.router", "cov", "cov.router", "color", "color.router"]
    assert sum(p.numel() for name, ps in groups.items() if name not in ("feature", "offsets", "log_scaling") for p in ps) == 35_925
    assert rates.at("offsets", 15_000, 30_000, 5.0) == pytest.approx(5.0 * 1e-3)
    assert rates.at("opacity.router", 15_000, 30_000, 5.0) == pytest.approx(0.5 * 2e-4)
    assert rates.at("feature", 1, 30_000, 5.0) == 0.0075


def test_what_the_native_decode_does_not_cover_falls_back_or_is_refused():
    assert scene(Anchors(mix=FeatureBank()), n=4).fused_weights(1) is None
    if native.load() is None:
        pytest.skip("no compiled library")
    with pytest.raises(InputError, match=naming("feature bank", "--scene.decode auto")):
        scene(Anchors(mix=FeatureBank(), decode="native"), n=4).fused_weights(1)
    with pytest.raises(InputError, match=r"torch\.float64"):
        scene(Anchors(decode="native"), n=4).double().fused_weights(1)


def test_new_rows_have_the_columns_of_the_table():
    made = scene(Anchors(), n=5)
    made.table.append(made.new_rows(torch.tensor([[16, 0, -16]]), 0.16, torch.ones(1, 32)))
    assert len(made.table) == 6 and float(made.table.params["log_scaling"][5, 0].detach()) == pytest.approx(math.log(0.16))


def test_dropped_anchors():
    made = scene(Anchors(dropout=0.4, dropout_full=100), n=2000)
    torch.manual_seed(0)
    shares = [1 - len(made(camera(), step, Mode.TRAIN, EVERYTHING).rows) / len(made.table) for step in (1, 50, 100, 1000)]
    assert shares == pytest.approx([0.004, 0.2, 0.4, 0.4], abs=0.04)
    assert len(made(camera(), 1000, Mode.DRAW, EVERYTHING).rows) == len(made.table)
    with pytest.raises(InputError, match=naming("--scene.dropout")):
        check_fields(Anchors(dropout=1.0), "scene")
