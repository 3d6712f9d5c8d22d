"""The scalar peer renders the image of the reference and its gradient."""

import pytest
import torch

from scene_experts.bench import peer, raster
from scene_experts.bench.measure import choose_clock
from scene_experts.core.types import Gaussians
from scene_experts.native import library as native
from scene_experts.render.reference import ReferenceRasterizer


@pytest.mark.parametrize("level", native.LEVELS)
def test_the_peer_agrees_with_the_reference(level):
    found = peer.load(level) if level in native.list_levels() else None
    if found is None:
        pytest.skip("not installed")
    scene = raster.make_picture(300, 48, 32)
    forward, backward, image, gradient = found.draw(scene.gaussians, scene.camera, scene.upstream, choose_clock(1))
    g = scene.gaussians
    means = g.means.clone().requires_grad_()
    leaves = Gaussians(means, g.quats, g.scales, g.opacities, g.colors, g.source)
    expected = ReferenceRasterizer()(leaves, scene.camera, torch.zeros(3)).image
    expected.backward(scene.upstream)
    assert forward > 0 and backward > 0 and found.pairs > 0
    assert (image - expected).abs().mean() < 1e-5
    assert (gradient - means.grad).norm() < 1e-3 * means.grad.norm()


def test_there_is_no_peer_without_a_library(monkeypatch):
    assert peer.load(None) is None
    monkeypatch.setattr(native, "find", lambda level: None)
    assert peer.load("avx512") is None
