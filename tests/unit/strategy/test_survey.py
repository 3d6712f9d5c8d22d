"""Sums over the pixels of training views."""

from dataclasses import replace
from functools import partial

import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.strategy.survey import weigh_all, weigh_errors
from support.scenes import CAMERA, start_scene
from support.surveys import make_photo, make_survey


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["moe-gs", "sags"])
def test_sums_are_those_of_pictures_of_one_gaussian_each(recipe):
    scene, survey = start_scene(recipe), make_survey()
    weigh = partial(weigh_errors, quantile=0.7)
    decoded, sums = survey.see(scene, 2, 1, weigh)
    g = scene(CAMERA, 1, Mode.DRAW, survey.draw.visible).gaussians
    assert torch.equal(decoded.gaussians.source, g.source) and sums.shape == (len(g), 3) and not sums.requires_grad
    maps = weigh(survey.draw(g, CAMERA, survey.background).image.detach(), make_photo(2))
    for i in range(0, len(g), 7):  # a picture is linear in the colours
        one = torch.zeros_like(g.colors)
        one[i] = 1
        picture = survey.draw(replace(g, colors=one), CAMERA, torch.zeros(3)).image
        torch.testing.assert_close(sums[i], (picture * maps).sum((0, 1)).detach(), rtol=1e-4, atol=1e-5)
    assert (sums[:, 0] > 0).any() and (sums[:, 1] <= sums[:, 0] + 1e-5).all()
    assert torch.equal(survey.see(scene, 2, 1, weigh_all)[1][:, 0], sums[:, 0])


def test_high_errors_are_the_pixels_above_the_quantile():
    image, mask = torch.full((32, 48, 3), 0.5), torch.ones(32, 48)
    mask[:16] = 0
    for view, counted in ((make_photo(), slice(0, 32)), (make_photo(mask=mask), slice(16, 32))):
        maps = weigh_errors(image, view, 0.75)
        error = (image - view.image).abs().mean(2)[counted]
        limit = error.flatten().sort().values[round(0.75 * error.numel()) - 1]
        assert torch.equal(maps[counted, :, 1], (error > limit).float()) and torch.equal(maps[counted, :, 2], error)
        assert maps[counted, :, 0].min() == 1 and maps.sum((0, 1))[1] == error.numel() - round(0.75 * error.numel())
    assert weigh_errors(image, make_photo(mask=torch.zeros(32, 48)), 0.75).abs().sum() == 0


def test_samples_are_different_views():
    survey = make_survey(9)
    sample = lambda count: survey.sample(count, torch.Generator().manual_seed(3))  # noqa: E731
    assert len(set(sample(4))) == 4 and sample(4) == sample(4) and sorted(sample(0)) == sorted(sample(20)) == list(range(9))
