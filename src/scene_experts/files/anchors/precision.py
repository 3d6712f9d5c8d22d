"""How precisely a compact file holds each value of a scene of anchors.

A value is rounded to a multiple of its step. With steps q = sqrt(12 t / S), where S is the mean
square of the pictures' derivative by the value, every value adds about t to the pictures' mean
square error; that is the best division for a given error. A channel has a step, an anchor a class:
its steps are 2^class times those of the channels. A row of a network has a step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from scene_experts.scene.anchors.quantise import LEAST_SHARE, ROUNDED, coarse, find_steps

STACKED = ("w1", "b1", "w2", "b2")  # tensors whose first axis is the experts'
_FINE = 64.0  # steps of a deviation, without sensitivities
_FINE_ROWS = 128.0  # of a root mean square


@dataclass(frozen=True)
class Precision:
    """Steps of the columns and networks of N anchors."""

    steps: Mapping[str, Tensor]
    """feature [F], log_scaling [6], offsets [K * 3] float32: the steps of class 0."""
    classes: Tensor
    """[N] int64, from -2 to 4"""
    networks: Mapping[str, Tensor] = field(default_factory=dict)
    """By name in files: exponents [R] float32 of the rows' steps, 2^(exponent / 2)."""
    learned: bool = False
    """Whether a training has learned the steps and rounded the values to them (--rate)."""

    def at(self, theta: float) -> Precision:
        """Steps for `theta` times the error. Learned ones stay, and only networks change."""
        more = math.log2(theta)
        steps = {name: value if self.learned else coarse(value * 2.0 ** (more / 2)) for name, value in self.steps.items()}
        return replace(self, steps=steps, networks={name: value + more for name, value in self.networks.items()})


def rows_of(name: str, value: Tensor) -> Tensor:
    """A network's tensor as [E, R, C]: experts, rows with a step each, columns. name: in files."""
    last = name.rpartition(".")[2]
    if last in STACKED:
        return value.reshape(len(value), -1, value.shape[-1])
    return value.reshape(1, -1, value.shape[-1]) if value.dim() > 1 else value.reshape(1, 1, -1)


def is_exact(name: str) -> bool:
    """Whether a file holds a network's tensor as it is: routers choose experts by it."""
    return ".router" in name


def from_sensitivity(columns: Mapping[str, Tensor], networks: Mapping[str, Tensor]) -> Precision:
    """The steps of an error of 1 from sensitivities: columns [N, ...] by name, tensors of networks by
    name in files."""
    steps, classes = find_steps(columns)
    rows = {}
    for name, value in networks.items():
        if is_exact(name):
            continue
        mean = rows_of(name, value.double()).mean((0, 2))
        rows[name] = torch.log2(12 / mean.clamp_min(max(float(mean.mean()) * LEAST_SHARE, 1e-30))).float()
    return Precision(steps, classes, rows)


def from_spread(columns: Mapping[str, Tensor], networks: Mapping[str, Tensor]) -> Precision:
    """Fine steps for a scene whose pictures nobody can draw here: shares of each channel's
    deviation and of each row's root mean square."""
    steps = {}
    for name in ROUNDED:
        flat = columns[name].detach().double().flatten(1)
        if not len(flat):
            flat = torch.ones(1, flat.shape[1], dtype=torch.float64)
        spread, size = flat.std(0, correction=0), flat.square().mean(0).sqrt()
        steps[name] = coarse(torch.maximum(spread, size * LEAST_SHARE).clamp_min(max(float(spread.mean()) * LEAST_SHARE, 1e-6)) / _FINE)
    rows = {}
    for name, value in networks.items():
        if not is_exact(name):
            size = rows_of(name, value.detach().double()).square().mean((0, 2)).sqrt()
            rows[name] = 2 * torch.log2(size.clamp_min(1e-9) / _FINE_ROWS).float()
    return Precision(steps, torch.zeros(len(columns["feature"]), dtype=torch.long), rows)
