"""A frozen scene draws what the scene draws, bit for bit, for every recipe with anchors."""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Camera, Mode, Points
from scene_experts.native import library as native
from scene_experts.scene.anchors import decode as anchors
from scene_experts.scene.anchors import native_decode
from scene_experts.scene.anchors.balance import Balanced
from scene_experts.scene.anchors.experts import Experts
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.scene.anchors.frozen import Frozen, FrozenCuda
from scene_experts.scene.anchors.routers import Linear, Margin
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.training.recipes import RECIPES
from support.interpret import DEVICE, decode_by_triton, kernels
from support.messages import naming

needs_native = pytest.mark.skipif(native.load() is None, reason="no compiled library")
DONE = 1_000_000  # a step after every warm-up
ANCHORED = [name for name, (_, cfg) in RECIPES.items() if isinstance(cfg.scene, Anchors)]


def camera(index=0, x=0.3):
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([x, -0.2, 4.0])
    return Camera(pose, torch.tensor([[90.0, 0, 32], [0, 90, 24], [0, 0, 1]]), 64, 48, id=index)


def trained(config: Anchors, n=600) -> AnchorScene:
    """A scene whose columns look as after a training."""
    g = torch.Generator().manual_seed(3)
    xyz = torch.randn(n, 3, generator=g, dtype=torch.float64)
    torch.manual_seed(3)
    scene = config.start(Points(xyz, torch.zeros(n, 3, dtype=torch.uint8)), 5.0, [camera(i, 0.1 * i) for i in range(3)])
    for name, scale in (("feature", 0.7), ("offsets", 0.3)):
        scene.table.params[name].data.copy_(scale * torch.randn(scene.table.params[name].shape, generator=g))
    return scene


def halves(means, scales, camera):
    """A visibility test that leaves gaps."""
    return torch.arange(len(means)) % 3 != 1


def same(found, expected):
    assert torch.equal(found.rows, expected.rows) and torch.equal(found.raw_opacity, expected.raw_opacity)
    for name, value in vars(expected.gaussians).items():
        assert torch.equal(getattr(found.gaussians, name), value), name


@pytest.mark.parametrize("recipe", ANCHORED)
def test_every_recipe_draws_the_same_bits(recipe):
    scene = trained(RECIPES[recipe][1].scene)
    frozen = scene.frozen(DONE)
    if scene.fused_weights(DONE) is None:
        assert frozen is scene
        return
    assert isinstance(frozen, Frozen)
    for view in (camera(1), camera(7, -0.4)):
        with torch.no_grad():
            expected = scene(view, DONE, Mode.DRAW, halves)
        same(frozen(view, DONE, Mode.DRAW, halves), expected)
        assert len(expected.gaussians) and not frozen(view, DONE, Mode.DRAW, halves).gaussians.means.requires_grad


@needs_native
@pytest.mark.parametrize(
    "config",
    [
        Anchors(add_dist=("color",), decoder=Experts(num=7, top_k=3), hidden=24, F=20, K=3),
        Anchors(decoder=Experts(num=4, top_k=1, attributes=("cov",))),
        Anchors(decoder=Experts(num=16, top_k=5, router=Linear(input_pos=True))),
        Anchors(appearance=6),
        Anchors(appearance=6, decoder=Experts(top_k=None)),
        Anchors(decoder=Experts(router=Margin())),
        Anchors(decoder=Experts(router=Balanced(), top_k=1)),
    ],
    ids=["odd sizes", "top-1 of one attribute", "positions", "appearance", "appearance, dense", "margins", "balanced"],
)
def test_other_heads_draw_the_same_bits(config):
    scene = trained(config)
    frozen = scene.frozen(DONE)
    assert isinstance(frozen, Frozen)
    for view in (camera(1), camera(7, -0.4)):
        with torch.no_grad():
            same(frozen(view, DONE, Mode.DRAW, halves), scene(view, DONE, Mode.DRAW, halves))
    with torch.no_grad():
        composed = replace(config, decode="composed")
        scene.config = composed
        exact = scene(camera(1), DONE, Mode.DRAW, halves)
    torch.testing.assert_close(frozen(camera(1), DONE, Mode.DRAW, halves).raw_opacity, exact.raw_opacity, atol=1e-5, rtol=1e-4)


def test_on_cuda_appearance_codes_are_folded_before_the_routing():
    """Plain networks route nothing, so this needs no kernel."""
    scene = trained(Anchors(appearance=6), n=20)
    weights = {a: scene.heads[a].weights(DONE) for a in scene.heads}
    assert FrozenCuda(scene, weights, DONE).kept.nets.heads[2].shapes[0] == weights["color"].w1[:, :, :-6].shape


@pytest.mark.parametrize(
    "config",
    [Anchors(), Anchors(appearance=6, decoder=Experts()), Anchors(add_dist=("color",), decoder=Experts(top_k=1, attributes=("cov",)))],
    ids=["plain", "appearance", "one attribute"],
)
def test_on_cuda_the_same_bits_are_drawn(config, monkeypatch):
    kernels()
    monkeypatch.setattr(native_decode, "decode", decode_by_triton)  # what a scene on CUDA calls, here also for one in the interpreter
    monkeypatch.setattr(anchors, "no_kernels", lambda device: None)
    scene = trained(config, n=60).to(DEVICE)
    view = camera(1).to(DEVICE)
    seen = lambda means, scales, camera: torch.arange(len(means), device=means.device) % 3 != 1  # noqa: E731
    for step in (1, DONE):
        weights = scene.fused_weights(step)
        assert weights is not None
        with torch.no_grad():
            expected = scene(view, step, Mode.DRAW, seen)
        same(FrozenCuda(scene, weights, step)(view, step, Mode.DRAW, seen), expected)


@needs_native
def test_while_dense_all_gates_are_kept_and_nothing_seen_draws_nothing():
    scene = trained(RECIPES["moe-gs"][1].scene, n=50)
    frozen = scene.frozen(1)
    assert isinstance(frozen, Frozen) and frozen.kept[0].chosen is None and frozen.kept[0].gates is not None
    with torch.no_grad():
        same(frozen(camera(), 1, Mode.DRAW, halves), scene(camera(), 1, Mode.DRAW, halves))
    nothing = frozen(camera(), 1, Mode.DRAW, lambda means, scales, camera: torch.zeros(len(means), dtype=torch.bool))
    assert len(nothing.gaussians) == 0 and nothing.raw_opacity.shape == (0, scene.K)


@needs_native
def test_memory_is_what_it_says():
    scene = trained(RECIPES["moe-gs"][1].scene, n=100)
    frozen = scene.frozen(DONE)
    assert isinstance(frozen, Frozen) and frozen.bytes == len(scene.table) * (3 * 2 * (8 + 4) + 12)  # routing, scales


@needs_native
def test_another_step_and_training_are_refused():
    frozen = trained(Anchors(), n=20).frozen(7)
    with pytest.raises(ValueError, match=naming(7, 8)):
        frozen(camera(), 8, Mode.DRAW, halves)
    with pytest.raises(ValueError, match="TRAIN"):
        frozen(camera(), 7, Mode.TRAIN, halves)


def test_what_the_native_decode_does_not_cover_stays_itself():
    for config in (Anchors(decode="composed"), Anchors(mix=FeatureBank())):
        scene = trained(config, n=20)
        assert scene.frozen(7) is scene
