"""Rounding and masks of anchors: their formulas, the compiled decode against the torch form, and what is settled."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.types import Mode
from scene_experts.native import library as native
from scene_experts.scene import restore_scene
from scene_experts.scene.anchors.quantise import (
    CLASS,
    HIGH_CLASS,
    KEEP,
    LOW_CLASS,
    ROUNDED,
    RowRounding,
    Steps,
    channels,
    coarse,
    find_steps,
    price_masks,
)
from scene_experts.training.recipes import RECIPES
from support.scenes import CAMERA, start_scene

EVERYTHING = lambda means, scales, camera: torch.ones(len(means), dtype=torch.bool)  # noqa: E731


def rounded_scene(recipe="scaffold-gs", decode="auto"):
    """A scene of about 200 anchors with random values, steps, classes and masks."""
    cfg = RECIPES[recipe][1]
    made = start_scene(replace(cfg, scene=replace(cfg.scene, decode=decode)))
    g = torch.Generator().manual_seed(1)
    n, F, K = len(made.table), made.config.F, made.K
    for name in ROUNDED:
        value = made.table.params[name].data
        value += 0.3 * torch.randn(value.shape, generator=g)
    steps, classes = 0.02 + 0.1 * torch.rand(channels(F, K), generator=g), torch.randint(LOW_CLASS, HIGH_CLASS + 1, (n,), generator=g)
    made.start_rounding(steps, classes, 0.3)
    made.table.params[KEEP].data.copy_(torch.randn(n, K, generator=g))
    made.table.params[KEEP].data[:20] = -1.0
    made.table.params[KEEP].data[20:, 0] = 1.0
    return made


def draw(made, step=5000):
    decoded = made(CAMERA, step, Mode.TRAIN, EVERYTHING)
    g = decoded.gaussians
    weights = torch.Generator().manual_seed(2)
    total = sum(
        (getattr(g, n) * torch.randn(getattr(g, n).shape, generator=weights)).sum() for n in ("means", "scales", "opacities", "colors")
    )
    total.backward()
    return decoded, {name: p.grad.clone() for name, p in made.named_parameters() if p.grad is not None}


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
@pytest.mark.parametrize("recipe", ["scaffold-gs", "moe-gs", "octree-gs", "moe-gs-balance"])
def test_the_compiled_decode_rounds_as_the_composed_one(recipe):
    (fast, a), (slow, b) = draw(rounded_scene(recipe)), draw(rounded_scene(recipe, "composed"))
    assert torch.equal(fast.gaussians.source, slow.gaussians.source) and len(fast.gaussians)
    assert (fast.gaussians.source >= 200).all()  # the anchors that are closed are not drawn
    for name in ("means", "scales", "opacities", "colors", "quats"):
        torch.testing.assert_close(getattr(fast.gaussians, name), getattr(slow.gaussians, name), rtol=1e-4, atol=1e-5)
    assert a.keys() == b.keys() >= {"steps.log_steps", "table.params.keep"}
    for name, gradient in a.items():
        torch.testing.assert_close(gradient, b[name], rtol=1e-3, atol=1e-4 * float(b[name].abs().max()))


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
def test_rounding_is_the_same_bits_on_all_threads(monkeypatch):
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(native, "count_threads", lambda n=threads: n)
        found.append(draw(rounded_scene())[1])
    assert all(torch.equal(value, found[1][name]) for name, value in found[0].items())


def test_values_are_multiples_and_steps_have_the_gradient_of_the_formula():
    g = torch.Generator().manual_seed(0)
    columns = [torch.randn(5, 4, generator=g), torch.randn(5, 6, generator=g), torch.randn(5, 2, 3, generator=g)]
    log_steps = torch.full((16,), -1.0, requires_grad=True)
    classes = torch.tensor([-2, 0, 1, 3, 4])
    rounding = RowRounding(log_steps, classes, torch.ones(5, 2), 2.0)
    columns = [c.requires_grad_() for c in columns]
    found = torch.cat([c.flatten(1) for c in rounding.round(columns)], 1)
    step = torch.tensor(-1.0).exp() * 2.0 ** classes[:, None]
    exact = torch.cat([c.detach().flatten(1) for c in columns], 1)
    origin = torch.tensor([0.0] * 4 + [math.log(2)] * 6 + [0.0] * 6)
    torch.testing.assert_close(found.detach(), torch.round((exact - origin) / step) * step + origin)
    upstream = torch.randn(5, 16, generator=g)
    found.backward(upstream)
    assert torch.equal(torch.cat([c.grad.flatten(1) for c in columns], 1), upstream)
    torch.testing.assert_close(log_steps.grad, (upstream * (found.detach() - exact)).sum(0))
    held = torch.round((exact - origin) / step)  # the formula is the derivative of r s minus that of v = (v / s) s, with r and v / s held
    away = lambda log: (held - (exact - origin) / step) * log.exp() * 2.0 ** classes[:, None]  # noqa: E731
    numeric = (away(torch.tensor(-1.0 + 1e-3)) - away(torch.tensor(-1.0 - 1e-3))) / 2e-3
    torch.testing.assert_close(log_steps.grad, (upstream * numeric).sum(0), rtol=1e-3, atol=1e-3)


def test_masks_have_the_gradient_of_a_factor():
    made = rounded_scene(decode="composed")
    decoded = made(CAMERA, 1, Mode.TRAIN, EVERYTHING)
    decoded.gaussians.opacities.sum().backward()
    keep, source = made.table.params[KEEP], decoded.gaussians.source
    assert (keep.detach().view(-1)[source] > 0).all()
    logits = keep.detach().double().view(-1)[source]
    slope = ((logits + 1e-5).sigmoid() - (logits - 1e-5).sigmoid()) / 2e-5
    expected = torch.zeros(keep.numel(), dtype=torch.float64).index_add(0, source, slope * decoded.gaussians.opacities.detach())
    torch.testing.assert_close(keep.grad.view(-1).double(), expected, rtol=1e-4, atol=1e-7)


def test_a_mask_pays_its_slot_and_its_share_of_the_anchor():
    keep = torch.tensor([[1.0, -1.0, 2.0], [-1.0, -2.0, 0.5], [-1.0, -1.0, -1.0]])
    slope = keep.sigmoid() * (1 - keep.sigmoid())
    assert torch.equal(price_masks(keep, 12.0, 160.0), slope * (12 + 160 / torch.tensor([[2.0], [1.0], [1.0]])))


def test_steps_divide_an_error_among_values():
    S = {"feature": torch.ones(4, 2), "log_scaling": torch.full((4, 6), 4.0), "offsets": torch.full((4, 1, 3), 0.25)}
    S = {name: value * torch.tensor([1.0, 1.0, 1.0, 1 / 64]).reshape(4, *[1] * (value.dim() - 1)) for name, value in S.items()}
    steps, classes = find_steps(S)
    mean = (3 + 1 / 64) / 4
    for name, value in (("feature", 1.0), ("log_scaling", 4.0), ("offsets", 0.25)):
        torch.testing.assert_close(steps[name], torch.full_like(steps[name], (12 / (value * mean)) ** 0.5))
    assert classes.tolist() == [0, 0, 0, 3]


@pytest.mark.parametrize("recipe", ["scene-experts", "octree-gs"])
def test_a_settled_scene_is_drawn_as_it_was_trained(recipe):
    made = rounded_scene(recipe)
    made.steps.log_steps.data.copy_(made.steps.stated.double().log())
    state = {f"params.{k}": v.detach() for k, v in made.table.params.items()} | {f"facts.{k}": v for k, v in made.table.facts.items()}
    state |= {f"network.{k}": v.detach() for k, v in made.network_tensors().items()}
    again = restore_scene(made.config, state, made.meta(), averaged=True)
    assert made.rounding is not None and again.rounding is None and len(again.table) == len(made.table) - 20
    assert KEEP not in again.table.params and torch.equal(again.table.facts[CLASS], made.table.facts[CLASS][20:])
    with torch.no_grad():
        a, b = made(CAMERA, 5000, Mode.DRAW, EVERYTHING).gaussians, again(CAMERA, 5000, Mode.DRAW, EVERYTHING).gaussians
    assert torch.equal(a.source - 20 * made.K, b.source)
    torch.testing.assert_close(a.means, b.means)
    going_on = restore_scene(made.config, state, made.meta())
    assert torch.equal(going_on.rounding.open, made.rounding.open)


def test_new_rows_begin_open_and_with_the_steps_of_the_channels():
    made = rounded_scene()
    made.table.append(made.new_rows(torch.tensor([[900, 900, 900]]), 0.1, torch.zeros(1, made.config.F)))
    assert made.rounding.open[-1].all() and int(made.table.facts[CLASS][-1]) == 0


def test_damaged_steps_are_refused():
    assert coarse(torch.tensor([0.123456, 1e-40])).tolist() == pytest.approx([0.1235, 1e-30])
    whole = {"values": [0.5] * 14, "scale": 2.0}
    assert Steps.from_plain(whole, 5, 1).plain() == whole
    for wrong in ([0.5] * 13, [0.5] * 13 + [0.0], [0.5] * 13 + ["x"]):
        with pytest.raises(Damaged):
            Steps.from_plain({**whole, "values": wrong}, 5, 1)
    with pytest.raises(Damaged):
        Steps.from_plain({**whole, "scale": 0.0}, 5, 1)


def test_plain_scenes_refuse_to_round():
    with pytest.raises(ValueError, match="rounded"):
        start_scene("3dgs").start_rounding(torch.ones(1), torch.zeros(1))
