"""Views without autograd against views with it: values, gradients and statistics of every recipe and term.

In Triton's interpreter with the CPU's rasteriser; on a GPU with gsplat, whose sums differ in the last bits from run to run.
"""

from dataclasses import replace

import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.render import choose, for_training
from scene_experts.scene.anchors import decode as anchors
from scene_experts.scene.anchors.routers import Margin
from scene_experts.scene.anchors.select import Octree
from scene_experts.scene.poses import attach
from scene_experts.training.direct import DirectStep, ThroughAutograd
from scene_experts.training.losses import Sample, Weights, compute_terms
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.interpret import DEVICE, decode_by_triton, kernels
from support.synthetic import make_capture
from support.trainings import start_changed

CLOSE = 1e-5 if DEVICE == "cpu" else 1e-4  # relative, of losses and of the norm of a gradient
ROUNDED = (
    1e-4  # of gradients of explicit Gaussians: their kernels round a last bit otherwise than torch, test_triton_gaussians.py has them alone
)
LATE = 20_000  # an iteration after every warm-up
MANY = {"dropout": 0.3, "dropout_full": 1, "view_jitter": 0.5}


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    kernels()  # skips this file where triton is not installed
    return load(make_capture(tmp_path_factory.mktemp("capture"), views=4).folder)


def varied(recipe, scene=(), loss=(), decoder=(), growth=()):
    cfg = RECIPES[recipe][1]
    scene = dict(scene)
    if decoder:
        scene["decoder"] = replace(cfg.scene.decoder, **dict(decoder))
    cfg = replace(cfg, scene=replace(cfg.scene, **scene), loss=replace(cfg.loss, **dict(loss)), growth=replace(cfg.growth, **dict(growth)))
    return replace(cfg, scene=replace(cfg.scene, **({"K": 4} if hasattr(cfg.scene, "K") else {}))).scaled()


RESIDUALS = {"residual_quantile": 0.7, "residual_weight": 0.2, "residual_from": 0}
TERMS = {"scale": 0.5, "opacity": 0.3, "tau": 0.1}
CASES = {
    "scaffold-gs": (varied("scaffold-gs", loss=TERMS), 1, ""),
    "no picture terms but L1": (varied("scaffold-gs", loss={**TERMS, "dssim": 0.0}), 1, ""),
    "a masked photograph": (varied("scaffold-gs", loss=TERMS), 1, ""),
    "large residuals count less": (varied("scaffold-gs", loss={**TERMS, **RESIDUALS}), 1, ""),
    "absolute gradients": (varied("scaffold-gs", growth={"gradient": "absolute"}), 1, ""),
    "the distance too": (varied("scaffold-gs-dist", loss=TERMS), 1, ""),
    "distance for one": (varied("scaffold-gs", scene={"add_dist": ("cov",)}), 1, ""),
    "appearance": (varied("scaffold-gs", scene={"appearance": 5}), 1, ""),
    "appearance and places": (varied("scene-experts", scene={"appearance": 5}), 1, ""),
    "exposures": (replace(varied("scaffold-gs", loss=TERMS), exposure=True), 1, ""),
    "refined poses": (replace(varied("scaffold-gs", loss=TERMS), refine_poses=True), 1, ""),
    "dropped and displaced": (varied("scaffold-gs", scene=MANY), 1, ""),
    "smoothed": (varied("scaffold-gs", scene={"smoothing": 0.2}, loss=TERMS), 1, ""),
    "masked slots": (varied("scaffold-gs", loss=TERMS), 1, ""),
    "octree-gs": (varied("octree-gs", loss=TERMS), LATE, ""),
    "octree-gs, blended": (varied("octree-gs", scene={"select": Octree(rule="blend")}, loss=TERMS), LATE, ""),
    "moe-gs, dense": (varied("moe-gs", loss={**TERMS, "load": 0.2}), 1, ""),
    "moe-gs, sparse": (varied("moe-gs", loss={**TERMS, "load": 0.2}), LATE, ""),
    "moe-gs without load": (varied("moe-gs-no-load"), LATE, ""),
    "two experts for the colour": (varied("moe-gs", decoder={"num": 2, "attributes": ("color",)}, loss={"load": 0.2}), LATE, ""),
    "many experts": (varied("moe-gs", decoder={"num": 7, "top_k": 2}, loss={"load": 0.2}), LATE, ""),
    "one of three": (varied("moe-gs-e3-top1", loss={"load": 0.2}), LATE, ""),
    "one of three without load": (varied("moe-gs-e3-top1", loss={"load": 0.0}), LATE, ""),
    "routers that see positions": (varied("moe-gs-posrouter", loss={"load": 0.2}), LATE, ""),
    "scene-experts, one": (varied("scene-experts", loss=TERMS), 1, ""),
    "scene-experts, places": (varied("scene-experts", loss=TERMS), LATE, ""),
    "a margin router": (varied("moe-gs", decoder={"router": Margin()}, loss={"load": 0.2}), LATE, "without a kernel"),
    "balanced": (varied("moe-gs-balance"), LATE, "without a kernel"),
    "a bank": (varied("scaffold-gs-bank", loss=TERMS), 1, "bank"),
    "octree-moe-gs": (varied("octree-moe-gs", loss={"load": 0.2}), LATE, ""),
    "3dgs": (varied("3dgs"), LATE, ""),
    "3dgs, its first harmonics": (varied("3dgs", loss={"scale": 0.5}), 1, ""),
    "3dgs-mcmc": (varied("3dgs-mcmc", scene={"sh_degree": 2}), LATE, ""),
    "sags": (varied("sags"), 1, "without kernels"),
}


def see(capture, cfg, step, name, direct):
    """One view of a training: decoded, render, terms, gradients by name, statistics, why autograd."""
    training = start_changed(cfg, capture, DEVICE)
    scene, draw = training.scene, for_training(choose("auto", DEVICE), cfg.growth.absolute)
    scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    scene.begin_iteration(0, step, training.companions)
    if name == "masked slots":
        scene.table.facts["slots"] = (torch.rand(len(scene.table), scene.K, generator=torch.Generator().manual_seed(1)) > 0.3).to(DEVICE)
    index = capture.train[0]
    camera, background = capture.views[index].camera.to(DEVICE, torch.float32), torch.tensor([0.2, 0.4, 0.9], device=DEVICE)
    target = capture.frame(index).rgb.to(DEVICE).float() / 255
    mask = torch.rand(target.shape[:2], generator=torch.Generator().manual_seed(2)).to(DEVICE) if name == "a masked photograph" else None
    torch.manual_seed(3)
    why = None
    if direct:
        drawing = DirectStep(draw, cfg.loss)
        decoded, render, terms = drawing.see(scene, camera, step, target, mask, background)
        why = drawing.why
        assert isinstance(drawing.drawing, ThroughAutograd) == bool(why)
    else:
        decoded = scene(camera, step, Mode.TRAIN, draw.visible)
        g = decoded.gaussians if scene.poses is None else attach(decoded.gaussians, scene.poses.pose_of(camera))
        render = draw(g, camera, background)
        render = replace(render, image=scene.as_photographed(render.image, camera))
        terms = compute_terms(Sample(decoded, render, target, mask, step), cfg.loss)
        torch.stack(list(terms.values())).sum().backward()
    cfg.growth.observe(scene, decoded, render, max(step, getattr(cfg.growth, "start_stat", 0)) if step == 1 else step)
    names = {id(p): n for n, p in scene.named_parameters()}
    gradients = {names[id(p)]: p.grad for g in training.optimizer.param_groups for p in g["params"] if p.grad is not None}
    return decoded, render, {n: float(v) for n, v in terms.items()}, gradients, dict(scene.table.stats), why


def distance(a, b):
    return float((a.double() - b.double()).norm()) / max(float(b.double().norm()), 1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_a_view_is_that_of_autograd(name, capture, monkeypatch):
    monkeypatch.setattr(anchors.native_decode, "decode", decode_by_triton)  # else an alpha may pass its threshold in one of the two
    cfg, step, why = CASES[name]
    found, expected = see(capture, cfg, step, name, True), see(capture, cfg, step, name, False)
    assert why in found[5] and bool(why) == bool(found[5])
    assert torch.equal(found[0].rows, expected[0].rows) and torch.equal(found[0].gaussians.source, expected[0].gaussians.source)
    assert distance(found[1].image, expected[1].image.detach()) < CLOSE
    assert found[2].keys() == expected[2].keys()
    for term, value in expected[2].items():
        assert abs(found[2][term] - value) <= CLOSE * abs(value), term
    close = ROUNDED if name.startswith("3dgs") else CLOSE * 3
    most = max(float(g.norm()) for g in expected[3].values())
    for parameter, gradient in expected[3].items():
        if float(gradient.norm()) > 1e-4 * most:
            assert distance(found[3][parameter], gradient) < close, parameter
    assert found[3].keys() >= {n for n, g in expected[3].items() if g.any()}
    assert found[4].keys() == expected[4].keys()
    for column, value in expected[4].items():
        assert distance(found[4][column], value) < close, column
    assert found[0].routing.keys() == expected[0].routing.keys()
    for attribute, r in expected[0].routing.items():
        assert distance(found[0].routing[attribute].gates, r.gates.detach()) < CLOSE


def test_views_are_left_to_autograd_where_nothing_else_can_draw_them():
    own = type("Own", (Weights,), {"terms": (*Weights.terms, lambda w, sample: {})})
    reference = choose("reference", "cpu")
    assert DirectStep(reference, own()).refused == "a loss with other terms"
    assert "reference" in DirectStep(reference, Weights()).refused
    assert "reference" in DirectStep(reference, Weights()).describe(None, 1)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["scene-experts, one", "appearance", "moe-gs, sparse"])
def test_gradients_of_two_views_of_a_batch_add_up(name, capture):
    cfg, step, _ = CASES[name]
    training = start_changed(cfg, capture, DEVICE)
    training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    training.scene.begin_iteration(0, step, training.companions)
    drawing, background = DirectStep(for_training(choose("auto", DEVICE), False), cfg.loss), torch.zeros(3, device=DEVICE)
    parameters = [p for g in training.optimizer.param_groups for p in g["params"] if p.requires_grad]

    def gradients(views):
        training.optimizer.zero_grad()
        for index in views:
            torch.manual_seed(index)
            camera = capture.views[index].camera.to(DEVICE, torch.float32)
            drawing.see(training.scene, camera, step, capture.frame(index).rgb.to(DEVICE) / 255, None, background)
        return [torch.zeros_like(p) if p.grad is None else p.grad.clone() for p in parameters]

    a, b = capture.train[:2]
    for both, one, other in zip(gradients([a, b]), gradients([a]), gradients([b])):
        torch.testing.assert_close(both, one + other, rtol=1e-5, atol=1e-6 * float(both.abs().max()) + 1e-12)
