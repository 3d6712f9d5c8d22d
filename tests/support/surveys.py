"""Surveys of random photographs from one camera."""

import torch

from scene_experts.render import choose
from scene_experts.strategy.survey import Survey, TrainingPhoto
from support.scenes import CAMERA


def make_photo(seed=0, mask=None) -> TrainingPhoto:
    return TrainingPhoto(CAMERA, torch.rand(32, 48, 3, generator=torch.Generator().manual_seed(seed)), mask)


def make_survey(count=5, rasterizer="reference") -> Survey:
    return Survey(range(count), make_photo, choose(rasterizer, "cpu"), torch.tensor([0.2, 0.5, 0.1]))
