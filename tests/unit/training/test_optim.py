"""Adam against torch's own, and its row form against the rule written out in float64."""

import copy

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.native import library as native
from scene_experts.training.optim import Adam, FusedAdam, _by_torch

SHAPES = [(300, 32), (300, 10, 3), (300, 6), (64, 35), (7,), (1,), (0, 4)]


def parameters(seed=0):
    torch.manual_seed(seed)
    return [torch.nn.Parameter(torch.randn(s)) for s in SHAPES]


def gradients(step):
    generator = torch.Generator().manual_seed(step)
    for shape in SHAPES:
        size = 10.0 ** torch.empty(shape).uniform_(-12, 2, generator=generator)
        yield torch.randn(shape, generator=generator) * size * (torch.rand(shape, generator=generator) > 0.3)


def groups(tensors):
    return [{"params": [p], "lr": 0.0075, "by_row": i < 3} for i, p in enumerate(tensors)]


def trained(optimizer, tensors, steps, **kwargs):
    for step in steps:
        for p, g in zip(tensors, gradients(step)):
            p.grad = g
        optimizer.step(**kwargs)
    return optimizer


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
@pytest.mark.parametrize("threads", [1, 2])
def test_it_is_torchs_fused_adam_bit_for_bit(threads):
    ours, theirs, before = parameters(), parameters(), torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        a = trained(FusedAdam(groups(ours)), ours, range(12))
        b = trained(torch.optim.Adam(groups(theirs), betas=(0.9, 0.999), eps=1e-15, fused=True), theirs, range(12))
    finally:
        torch.set_num_threads(before)
    exact = torch.backends.cpu.get_cpu_capability().startswith("AVX")  # elsewhere neither has fused products
    for x, y in zip(ours, theirs):
        assert list(a.state[x]) == list(b.state[y]) == ["step", "exp_avg", "exp_avg_sq"]
        for p, q in [(x, y), *zip(a.state[x].values(), b.state[y].values())]:
            assert torch.equal(p, q) if exact else torch.allclose(p, q, rtol=1e-3, atol=1e-6)


def test_a_parameter_without_gradient_stays_and_its_step_is_not_counted():
    tensors = parameters()
    optimizer = trained(FusedAdam(groups(tensors)), tensors, range(2))
    before = tensors[0].detach().clone()
    tensors[0].grad = None
    optimizer.step()
    assert torch.equal(tensors[0], before) and float(optimizer.state[tensors[0]]["step"]) == 2
    assert float(optimizer.state[tensors[1]]["step"]) == 3


@pytest.mark.parametrize("composed", [False, True])
def test_only_the_given_rows_of_a_table_move(composed):
    tensors = parameters()
    optimizer = FusedAdam(groups(tensors))
    optimizer._native &= not composed
    trained(optimizer, tensors, range(3))
    exact = [p.detach().double().requires_grad_() for p in tensors]
    states = copy.deepcopy([{k: v.double() for k, v in optimizer.state[p].items()} for p in tensors])
    rows = torch.tensor([0, 1, 2, 7, 250, 9, 299])
    trained(optimizer, tensors, [3], rows=rows)
    for i, (p, q, s, g) in enumerate(zip(tensors, exact, states, gradients(3))):
        q.grad = g.double()
        with torch.no_grad():
            _by_torch(q, s, rows if i < 3 else None, 0.0075 / (1 - 0.9**4), (1 - 0.999**4) ** 0.5, optimizer.param_groups[0])
        torch.testing.assert_close(p.detach().double(), q.detach(), rtol=1e-5, atol=1e-6)
        for name in ("exp_avg", "exp_avg_sq"):
            torch.testing.assert_close(optimizer.state[p][name].double(), s[name], rtol=1e-5, atol=1e-9)
        others = torch.ones(len(p), dtype=torch.bool)
        others[rows[rows < len(p)]] = i >= 3
        assert i >= 3 or torch.equal(optimizer.state[p]["exp_avg"][others], s["exp_avg"][others].float())


def test_all_rows_are_the_whole_table():
    some, whole = parameters(), parameters()
    trained(FusedAdam(groups(some)), some, range(4), rows=torch.arange(300))
    trained(FusedAdam(groups(whole)), whole, range(4))
    assert all(torch.allclose(a, b, rtol=1e-6, atol=0) for a, b in zip(some, whole))


def test_other_dtypes_take_torchs_way():
    tensors = [torch.nn.Parameter(torch.ones(3, dtype=torch.float64))]
    optimizer = FusedAdam([{"params": tensors, "lr": 0.1}])
    tensors[0].grad = torch.ones(3, dtype=torch.float64)
    optimizer.step()
    assert torch.allclose(tensors[0].detach(), torch.tensor(0.9, dtype=torch.float64))


def test_a_closure_is_called_once():
    tensors, calls = [torch.nn.Parameter(torch.ones(3))], []

    def closure():
        calls.append(1)
        loss = tensors[0].sum()
        loss.backward()
        return loss.detach()

    assert float(FusedAdam([{"params": tensors, "lr": 0.1}]).step(closure)) == 3 and len(calls) == 1


def test_the_part_builds_it_with_its_numbers():
    tensor = torch.nn.Parameter(torch.ones(3))
    built = Adam(betas=(0.8, 0.9), eps=1e-8).build([{"params": [tensor], "name": "a", "lr": 0.0, "by_row": True}])
    assert isinstance(built, FusedAdam) and built.param_groups[0]["betas"] == (0.8, 0.9) and built.param_groups[0]["eps"] == 1e-8
    assert Adam().scaled(0.5) == Adam()
    for wrong in (Adam(betas=(1.0, 0.9)), Adam(eps=-1.0)):
        with pytest.raises(InputError, match="--optimizer"):
            check_fields(wrong, "optimizer")


@pytest.mark.skipif(native.load() is None, reason="no compiled library")
@pytest.mark.parametrize("rows", [None, torch.tensor([0, 1, 2, 7, 63])])
@pytest.mark.parametrize("level", native.LEVELS)
def test_the_native_step_names_the_first_parameter_that_is_not_finite(rows, level, monkeypatch):
    if native.load(level) is None:
        pytest.skip("not of this processor")
    monkeypatch.setattr(native, "require", lambda chosen=None, of=native.require: of(level))
    for bad, value in ((i, value) for i in range(6) for value in (float("nan"), float("inf"), 1e25)):
        tensors = parameters()
        optimizer = trained(
            FusedAdam([{**group, "name": f"p{i}"} for i, group in enumerate(groups(tensors))]), tensors, range(2), rows=rows
        )
        assert optimizer.broken == ""
        for p, g in zip(tensors, gradients(2)):
            p.grad = g
        for i in {bad, 5}:
            row = 63 if rows is not None and i < 3 else -1  # the last element that the step reads
            tensors[i].grad.reshape(len(tensors[i]), -1)[row, -1] = value
        optimizer.step(rows=rows)
        assert optimizer.broken == f"p{bad}", value
