"""How long the iterations of a training take, relative to each other: for the times that are told."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch

from scene_experts.training.config import Train
from scene_experts.training.early import PictureSize, is_shrunk

GROWN = 0.6
"""Iterations become this much longer on a CPU once a scene has grown, in the second half. A whole
training takes 1.37 times ten first tenths then. Measured were 1.17 to 1.33 in five on banana without
other work; beside other processes 1.05 on South Building, 1.44 on bonsai, and 1.3 to 2.6 in eight
older trainings (results/to-page.md)."""
PER_MEGAPIXEL = 2.3
"""What a megapixel adds to an iteration on a CPU, as a share of what it takes without any: with it a
training that sees half the size first takes 0.84 times as long at 0.4 megapixels (fox 0.82, banana
0.865, results/default.md)."""


@dataclass(frozen=True)
class Course:
    """The cost of a training's iterations. The unit is the first of them."""

    total: int
    """Iterations of the whole training."""
    grown: float = 0.0
    """By how much iterations become longer while the scene grows, in the first half."""
    switch: int = 0
    """Iteration after which photographs are seen as they are (--half-until)."""
    slower: float = 1.0
    """How many times longer iterations take from there."""

    def spent(self, step: int) -> float:
        """Return the cost of the first `step` iterations."""
        before = self._without(min(step, self.switch))
        return before + self.slower * (self._without(step) - before)

    def _without(self, step: int) -> float:
        growing = min(step, self.total / 2)
        return step + self.grown * (growing**2 / self.total + step - growing)


def find_course(cfg: Train, cameras: Sequence[PictureSize], cuda: bool | None = None) -> Course:
    """Return the course of a training on this machine. On a GPU nothing was measured: its iterations
    count alike.

    cfg: Scaled. cameras: Of the training views. cuda: Whether there is a GPU; None: as there is.
    """
    if torch.cuda.is_available() if cuda is None else cuda:
        return Course(cfg.iterations)
    sizes = [(camera.width * camera.height / 1e6, is_shrunk(camera)) for camera in cameras]
    whole = sum(cost_of(pixels) for pixels, _ in sizes)
    at_first = sum(cost_of(pixels / 4 if small else pixels) for pixels, small in sizes)
    slower = whole / at_first if cameras and cfg.half_until else 1.0
    return Course(cfg.iterations, GROWN, cfg.half_until, slower)


def cost_of(pixels: float) -> float:
    """Return what an iteration with so many megapixels costs on a CPU, relative to one that draws no
    pixel."""
    return 1 + PER_MEGAPIXEL * pixels
