"""Steps from sensitivities: every value adds the same error, and classes are powers of two."""

import pytest
import torch

from scene_experts.files.anchors.precision import coarse, from_sensitivity, from_spread, is_exact, rows_of

N, F, K = 400, 5, 2


def sensitivities():
    g = torch.Generator().manual_seed(0)
    weight = 4.0 ** torch.randint(-2, 5, (N,), generator=g)  # of anchors
    new = lambda *shape: (torch.rand(*shape, generator=g) + 0.5) * 1e-6  # noqa: E731
    columns = {"feature": new(1, F), "log_scaling": new(1, 6), "offsets": new(1, K, 3)}
    columns = {name: value * (1 / weight).view(N, *[1] * (value.dim() - 1)) for name, value in columns.items()}
    return columns, {"color.experts.w1": new(3, 4, 7), "color.experts.b1": new(3, 4), "color.router.weight": new(3, 2)}, weight


def test_every_value_adds_the_same_error():
    columns, networks, weight = sensitivities()
    found = from_sensitivity(columns, networks).at(1e-9)
    assert found.classes.min() >= -2 and found.classes.max() <= 4
    steps = found.steps["feature"] * 2.0 ** found.classes[:, None]
    errors = columns["feature"] * steps.square() / 12
    typical = errors[(found.classes > -2) & (found.classes < 4)]
    assert typical.max() < 2.5 * typical.min()
    assert torch.equal(found.classes[weight == 16].unique(), found.classes[weight == 16][:1])
    exponents = found.networks["color.experts.w1"]
    mean = networks["color.experts.w1"].mean((0, 2))
    torch.testing.assert_close(mean * 2.0**exponents / 12, torch.full((4,), 1e-9), rtol=1e-3, atol=0)
    assert found.networks["color.experts.b1"].shape == (1,) and "color.router.weight" not in found.networks


def test_four_times_the_error_is_twice_the_step():
    columns, networks, _ = sensitivities()
    base = from_sensitivity(columns, networks)
    one, four = base.at(1e-8), base.at(4e-8)
    torch.testing.assert_close(four.steps["offsets"], 2 * one.steps["offsets"], rtol=2e-3, atol=0)
    torch.testing.assert_close(four.networks["color.experts.w1"], one.networks["color.experts.w1"] + 2)
    assert torch.equal(one.classes, four.classes)


@pytest.mark.parametrize("n", [0, 3])
def test_values_that_no_picture_shows_get_finite_steps(n):
    columns = {"feature": torch.zeros(n, F), "log_scaling": torch.zeros(n, 6), "offsets": torch.zeros(n, K, 3)}
    for found in (from_sensitivity(columns, {}).at(1e-9), from_spread(columns, {"a.w1": torch.zeros(1, 2, 3)})):
        assert all(step.isfinite().all() and (step > 0).all() for step in found.steps.values()) and len(found.classes) == n


def test_rows_and_exact_tensors():
    assert rows_of("color.experts.w1", torch.zeros(5, 4, 7)).shape == (5, 4, 7)
    assert rows_of("color.experts.b1", torch.zeros(5, 4)).shape == (5, 1, 4)
    assert rows_of("appearance.table", torch.zeros(5, 4)).shape == (1, 5, 4)
    assert rows_of("color.middle.0.bias", torch.zeros(9)).shape == (1, 1, 9)
    assert is_exact("cov.router.bias") and not is_exact("cov.experts.b1")
    assert coarse(torch.tensor([0.123456])).item() == pytest.approx(0.1235)
