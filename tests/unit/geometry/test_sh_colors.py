"""Native colours against torch in float64: values and every gradient, for every instruction set."""

import pytest
import torch

from scene_experts.geometry.sh_colors import compute_in_torch, compute_sh_colors
from scene_experts.native import library as native

LEVELS = [level for level in native.list_levels() if native.load(level)]
NAMES = ("means", "dc", "rest")


def made(rows: int, table: int, coefficients: int = 16, dtype=torch.float64):
    torch.manual_seed(rows)
    means = torch.randn(rows, 3, dtype=dtype) * 2
    dc, rest = torch.randn(table, 3, dtype=dtype), torch.randn(table, coefficients - 1, 3, dtype=dtype) * 0.3
    return means, dc, rest, torch.randperm(table)[:rows], torch.tensor([0.3, -0.2, 0.1], dtype=dtype)


def gradients(function, means, dc, rest, rows, position, degree):
    leaves = [t.clone().requires_grad_() for t in (means, dc, rest)]
    out = function(*leaves, rows, position, degree)
    weight = torch.linspace(-1, 1, out.numel(), dtype=torch.float64).view_as(out).to(out.dtype)
    return out.detach(), torch.autograd.grad((out * weight).sum(), leaves, materialize_grads=True)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("rows", [1, 64, 203])
def test_native_colours_and_gradients_are_those_of_torch(level, degree, rows, monkeypatch):
    library = native.load(level)
    monkeypatch.setattr(native, "load", lambda level=None: library)
    means, dc, rest, chosen, position = made(rows, 230)
    expected, by_float64 = gradients(compute_in_torch, means, dc, rest, chosen, position, degree)
    out, found = gradients(compute_sh_colors, means.float(), dc.float(), rest.float(), chosen, position.float(), degree)
    assert out.dtype == torch.float32 and ((out - expected).abs() <= 3e-6 * (1 + expected.abs())).all()
    for name, a, b in zip(NAMES, found, by_float64):
        assert a.shape == b.shape and (a - b).norm() <= 2e-6 * b.norm() + 1e-12, name


@pytest.mark.parametrize("degree", range(4))
def test_torch_gradients_are_finite_differences(degree):
    means, dc, rest, rows, position = made(5, 9)
    leaves = [t.requires_grad_() for t in (means, dc + 4.0, rest)]  # no colour is cut
    assert torch.autograd.gradcheck(lambda *t: compute_in_torch(*t, rows, position, degree), leaves)


def test_all_rows_and_any_number_of_threads_give_the_same_bits():
    means, dc, rest, _, position = (t.float() if t.is_floating_point() else t for t in made(300, 300))
    expected = gradients(compute_sh_colors, means, dc, rest, torch.arange(300), position, 3)
    threads = torch.get_num_threads()
    try:
        torch.set_num_threads(3)
        out, found = gradients(compute_sh_colors, means, dc, rest, None, position, 3)
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(out, expected[0]) and all(torch.equal(a, b) for a, b in zip(found, expected[1]))


def test_cut_colours_have_no_gradient_and_unused_coefficients_zero():
    means, dc, rest, rows, position = (t.float() if t.is_floating_point() else t for t in made(40, 40))
    out, (_, d_dc, d_rest) = gradients(compute_sh_colors, means, dc - 100, rest, rows, position, 2)
    assert not out.any() and not d_dc.any() and not d_rest.any()
    _, (_, _, d_rest) = gradients(compute_sh_colors, means, dc + 9, rest, rows, position, 1)
    assert d_rest[:, :3].any() and not d_rest[:, 3:].any()
    _, (d_means, d_dc, d_rest) = gradients(compute_sh_colors, means, dc, rest[:, :0], rows, position, 0)
    assert d_dc.any() and d_rest.shape == (40, 0, 3) and not d_means.any()


def test_no_rows_and_degrees_beyond_the_table():
    means, dc, rest, rows, position = made(3, 5, coefficients=4, dtype=torch.float32)
    assert compute_sh_colors(means[:0], dc, rest, rows[:0], position, 1).shape == (0, 3)
    for degree in (2, 4, -1):
        with pytest.raises(ValueError):
            compute_sh_colors(means, dc, rest, rows, position, degree)
