"""Bits of bins of a logistic distribution by their formula, and their derivatives against finite differences."""

import math

import pytest
import torch

from scene_experts.core.logistic import FLOOR, find_slopes, logistic_bits


def test_bits_are_those_of_the_bins_of_a_logistic_distribution():
    away, log_spread = torch.tensor([0.0, 0.3, -2.0, 40.0], dtype=torch.float64), torch.tensor([0.5, -1.0, 0.2, 0.0], dtype=torch.float64)
    cdf = lambda x, s: 1 / (1 + math.exp(-x / s))  # noqa: E731
    for a, t, bits in zip(away.tolist(), log_spread.tolist(), logistic_bits(away, log_spread).tolist()):
        share = cdf(a + 0.5, math.exp(t)) - cdf(a - 0.5, math.exp(t))
        assert bits == pytest.approx(-math.log2(share * (1 - 20 * FLOOR) + FLOOR))


def test_derivatives_are_finite_differences():
    torch.manual_seed(0)
    leaves = [(3 * torch.randn(20, dtype=torch.float64)).requires_grad_(), torch.randn(20, dtype=torch.float64).requires_grad_()]
    assert torch.autograd.gradcheck(logistic_bits, leaves)
    share, by_away, by_spread = find_slopes(*(leaf.detach() for leaf in leaves))
    torch.testing.assert_close(-share.log2(), logistic_bits(*leaves).detach())
    found = torch.autograd.grad(logistic_bits(*leaves).sum(), leaves)
    torch.testing.assert_close(found, (by_away, by_spread))
