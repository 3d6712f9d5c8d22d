"""MCMC densification against its formulas and against pictures."""

import math
from dataclasses import replace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.geometry.rotation import covariance
from scene_experts.native import library as native
from scene_experts.strategy import mcmc
from scene_experts.strategy.mcmc import MCMC, MOST, draw, share_opacity
from support.explicit import make_gaussians, moments


def as_written(o: float, n: int) -> tuple[float, float]:
    """Opacity and factor on the scales, term by term."""
    new = 1 - (1 - o) ** (1 / n)
    Q = sum(math.comb(i - 1, k) * (-1) ** k / math.sqrt(k + 1) * new ** (k + 1) for i in range(1, n + 1) for k in range(i))
    return new, o / Q


@pytest.mark.parametrize("n", [1, 2, 3, 10, 51])
@pytest.mark.parametrize("o", [0.006, 0.3, 0.9, 0.9999])
def test_shares_are_those_of_the_formula(o, n):
    new, factor = share_opacity(torch.tensor([o], dtype=torch.float64), torch.tensor([n]))
    assert (float(new), float(factor)) == pytest.approx(as_written(o, n), rel=1e-6)
    assert n > 1 or (float(new), float(factor)) == pytest.approx((o, 1.0))


def test_more_than_51_are_shared_as_51():
    o = torch.tensor([0.7])
    assert torch.equal(share_opacity(o, torch.tensor([MOST]))[0], share_opacity(o, torch.tensor([400]))[0])


@pytest.mark.parametrize("o", [0.3, 0.9])
def test_shares_together_hide_as_much_as_the_one_did(o):
    """Exact along a ray through the centre. In total, the scales keep the integral of the opacity."""
    n = 4
    new, factor = (float(v) for v in share_opacity(torch.tensor([o], dtype=torch.float64), torch.tensor([n])))
    assert 1 - (1 - new) ** n == pytest.approx(o)
    x = torch.linspace(-12, 12, 20_001, dtype=torch.float64)
    one, many = o * torch.exp(-x * x / 2), 1 - (1 - new * torch.exp(-x * x / (2 * factor**2))) ** n
    assert float(many.sum()) == pytest.approx(float(one.sum()), rel=1e-6)


def test_draws_follow_the_weights():
    weight = torch.tensor([0.0, 1.0, 0.0, 3.0, 0.0])
    found = draw(weight, 40_000, torch.Generator().manual_seed(0)).bincount(minlength=5)
    assert not found[[0, 2, 4]].any() and float(found[3] / found[1]) == pytest.approx(3, rel=0.05)


def test_the_dead_become_shares_of_the_living():
    scene, rule = make_gaussians(), MCMC()
    before = {name: value.detach().clone() for name, value in scene.table.params.items()}
    dead = before["raw_opacity"].sigmoid() <= 0.005
    moved = rule.relocate(scene, torch.Generator().manual_seed(0))
    after = scene.table.params
    assert moved == int(dead.sum()) > 10 and len(scene.table) == len(dead)
    assert float(after["raw_opacity"].detach().sigmoid().min()) >= 0.00499
    sources = {}
    for i in dead.nonzero().squeeze(1).tolist():
        (source,) = ((before["means"] == after["means"][i]).all(1) & ~dead).nonzero().squeeze(1).tolist()
        sources.setdefault(source, []).append(i)
    for source, rows in sources.items():
        new, factor = as_written(float(before["raw_opacity"][source].sigmoid()), len(rows) + 1)
        for row in (source, *rows):
            assert float(after["raw_opacity"].detach()[row].sigmoid()) == pytest.approx(max(new, 0.005), rel=1e-4)
            torch.testing.assert_close(after["log_scales"][row].detach(), before["log_scales"][source] + math.log(factor))
            assert torch.equal(after["sh_rest"][row], before["sh_rest"][source])
        for name in after:
            assert not moments(scene, name)[source].any() and moments(scene, name)[rows].any()
    untouched = [i for i in range(len(dead)) if not dead[i] and i not in sources]
    assert untouched and all(torch.equal(after[name][untouched], before[name][untouched]) for name in after)


def test_gaussians_are_added_up_to_the_cap():
    scene = make_gaussians()
    assert MCMC().add(scene, torch.Generator()) == (10, False) and len(scene.table) == 210
    assert not moments(scene, "means")[200:].any()
    assert MCMC().add(scene, torch.Generator(), cap=213) == (3, True)
    assert MCMC().add(scene, torch.Generator(), cap=100) == (0, True) and len(scene.table) == 213


def test_when_things_happen():
    rule = MCMC()
    for step, adjusts in ((500, False), (600, True), (650, False), (24_900, True), (25_000, False)):
        scene = make_gaussians(60)
        assert (rule.update(scene, step, torch.Generator()) is not None) == adjusts
        assert (scene.table.params["means"].grad is None) == adjusts
    empty = make_gaussians(60)
    empty.table.keep(torch.zeros(60, dtype=torch.bool))
    assert rule.update(empty, 600, torch.Generator()) is None
    everyone = make_gaussians(60)
    everyone.table.assign("raw_opacity", torch.full((60,), -9.0))
    assert rule.relocate(everyone, torch.Generator()) == 0  # nobody lives to be shared


def test_noise_has_the_shape_of_the_gaussian_and_spares_the_opaque():
    scene, rule = make_gaussians(1), MCMC()
    p = scene.table.params
    with torch.no_grad():
        p["raw_opacity"].fill_(math.log(0.005 / 0.995))  # where the gate is a half
    moves = []
    generator = torch.Generator().manual_seed(0)
    for _ in range(4000):
        before = p["means"].detach().clone()
        rule.finish(scene, 1, {"means": 1e-3}, generator)
        moves.append((p["means"].detach() - before)[0].double())
        with torch.no_grad():
            p["means"].copy_(before)
    found = torch.stack(moves)
    quats = torch.nn.functional.normalize(p["quats"].detach().double(), dim=1)
    half = covariance(quats, p["log_scales"].detach().double().exp())[0] * 0.5 * 1e-3 * 5e5  # Sigma eta
    expected = half @ half.T
    assert (found.T @ found / len(found) - expected).norm() < 0.1 * expected.norm()
    with torch.no_grad():
        p["raw_opacity"].fill_(2.0)
    before = p["means"].detach().clone()
    rule.finish(scene, 1, {"means": 1e-3}, generator)
    assert torch.equal(p["means"], before)
    with torch.no_grad():
        p["raw_opacity"].fill_(-5.0)
    replace(rule, noise=0.0).finish(scene, 1, {"means": 1e-3}, generator)
    assert torch.equal(p["means"], before)


@pytest.mark.parametrize("level", [level for level in native.list_levels() if native.load(level)])
@pytest.mark.parametrize("n", [1, 300])
def test_native_noise_is_that_of_torch(level, n, monkeypatch):
    library = native.load(level)
    monkeypatch.setattr(native, "load", lambda level=None: library)
    scene = make_gaussians(n)
    with torch.no_grad():
        scene.table.params["means"].zero_()
    columns = [scene.table.params[name].detach().clone().double() for name in ("means", "quats", "log_scales", "raw_opacity")]
    eta = torch.randn(n, 3, generator=torch.Generator().manual_seed(5)).double()
    mcmc.disturb(*columns, eta, 500.0, 0.005)
    MCMC().finish(scene, 1, {"means": 1e-3}, torch.Generator().manual_seed(5))
    torch.testing.assert_close(scene.table.params["means"].detach().double(), columns[0], rtol=2e-5, atol=1e-7)
    assert columns[0].any()


def test_impossible_numbers_are_refused():
    for rule, flag in ((MCMC(growth=0.9), r"growth\.growth"), (MCMC(noise=-1.0), r"growth\.noise")):
        with pytest.raises(InputError, match=flag):
            check_fields(rule, "growth")
