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

from scene_experts.files.codec.groups import HIGH_CLASS, LOW_CLASS

LEAST_SHARE = 1e-3  # of the mean sensitivity, that every channel has
STACKED = ("w1", "b1", "w2", "b2")  # tensors whose first axis is the experts'
ROUNDED = ("feature", "log_scaling", "offsets")
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

    def at(self, theta: float) -> Precision:
        """Steps for `theta` times the error."""
        more = math.log2(theta)
        steps = {name: coarse(value * 2.0 ** (more / 2)) for name, value in self.steps.items()}
        return replace(self, steps=steps, networks={name: value + more for name, value in self.networks.items()})


def coarse(values: Tensor) -> Tensor:
    """Positive values with four digits, as the header of a file states them."""
    return torch.tensor([float(f"{v:.4g}") for v in values.double().clamp(1e-30, 1e30).tolist()], dtype=torch.float64).float()


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
    steps, weighted = {}, torch.zeros(0)
    for name in ROUNDED:
        flat = columns[name].double().flatten(1)
        mean = flat.mean(0) if len(flat) else torch.zeros(flat.shape[1], dtype=torch.float64)
        mean = mean.clamp_min(max(float(mean.mean()) * LEAST_SHARE, 1e-30))
        steps[name] = (12 / mean).sqrt().float()
        share = (flat / mean).mean(1) / len(ROUNDED)
        weighted = share if not len(weighted) else weighted + share
    middle = weighted.mean().clamp_min(1e-30) if len(weighted) else torch.ones(())
    classes = (0.5 * torch.log2(middle / weighted.clamp_min(1e-12 * float(middle)))).round().clamp(LOW_CLASS, HIGH_CLASS).long()
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
