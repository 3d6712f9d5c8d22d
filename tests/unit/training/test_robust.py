"""Weights of pixels by their residuals."""

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.training.losses import Sample, Weights, photometric_terms
from scene_experts.training.photometric import photometric
from scene_experts.training.robust import weigh_residuals


def by_loops(image, target, quantile, weight):
    residual = (image - target).abs().mean(2)
    H, W = residual.shape
    limit = residual.flatten().sort().values[round(quantile * H * W) - 1]
    out = torch.empty(H, W)
    for i in range(H):
        for j in range(W):
            around = residual[max(0, i - 1) : i + 2, max(0, j - 1) : j + 2]
            out[i, j] = 1.0 if (around <= limit).float().mean() >= 0.5 else weight
    return out


def pictures():
    rng = torch.Generator().manual_seed(0)
    target = torch.rand(24, 30, 3, generator=rng)
    image = (target + 0.02 * torch.randn(24, 30, 3, generator=rng)).clamp(0, 1)
    image[5:13, 8:20] = 1 - target[5:13, 8:20]  # something that moved
    image[20, 3] = 1 - target[20, 3]  # a single pixel
    return image, target


def test_weights_are_those_of_the_definition():
    image, target = pictures()
    weights = weigh_residuals(image, target, 0.8, 0.25)
    assert torch.equal(weights, by_loops(image, target, 0.8, 0.25))
    assert (weights[6:12, 9:19] == 0.25).all() and weights[20, 3] == 1 and (weights == 1).float().mean() > 0.8


def test_the_quantile_is_over_unmasked_pixels():
    image, target = pictures()
    mask = torch.ones(24, 30)
    mask[:, 15:] = 0
    weights = weigh_residuals(image, target, 0.8, 0.0, mask)
    assert (weights[:, 15:] == 0).all()
    assert torch.equal(weights[:, :14], weigh_residuals(image[:, :15], target[:, :15], 0.8, 0.0)[:, :14])
    assert weigh_residuals(image, target, 0.8, 0.0, torch.zeros(24, 30)).sum() == 0


def test_the_loss_ignores_large_residuals_from_its_first_iteration_on():
    image, target = pictures()
    image.requires_grad_()

    class Render:
        pass

    render = Render()
    render.image = image

    def terms(step, **settings):
        return photometric_terms(Weights(residual_from=10, **settings), Sample(None, render, target, None, step))

    plain = photometric(image, target, 0.2)
    for found in (terms(9, residual_quantile=0.8), terms(10), terms(None)):
        assert found["l1"] == plain[0] and found["dssim"] == plain[1]
    found = terms(10, residual_quantile=0.8)
    expected = photometric(image, target, 0.2, weigh_residuals(image, target, 0.8, 0.0))
    assert found["l1"] == expected[0] and found["l1"] < 0.5 * plain[0]
    (found["l1"] + found["dssim"]).backward()
    assert image.grad[8, 14].abs().sum() == 0 and image.grad[20, 3].abs().sum() > 0


def test_settings():
    assert Weights(residual_quantile=0.9).scaled(0.1).residual_from == 150
    for bad in ({"residual_quantile": 1.5}, {"residual_weight": -0.1}):
        with pytest.raises(InputError, match="residual"):
            check_fields(Weights(**bad), "loss")
