"""Anchors to Gaussians against the paper's formulas, one Gaussian at a time."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.native import library as native
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.scene.anchors.scene import Anchors
from scene_experts.training.recipes import RECIPES
from support.anchor_scenes import EVERYTHING, camera, scene
from support.messages import naming


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


def test_what_the_native_decode_does_not_cover_falls_back_or_is_refused():
    assert scene(Anchors(mix=FeatureBank()), n=4).fused_weights(1) is None
    if native.load() is None:
        pytest.skip("no compiled library")
    with pytest.raises(InputError, match=naming("feature bank", "--scene.decode auto")):
        scene(Anchors(mix=FeatureBank(), decode="native"), n=4).fused_weights(1)
    with pytest.raises(InputError, match=r"torch\.float64"):
        scene(Anchors(decode="native"), n=4).double().fused_weights(1)
