"""Values of anchors as a compact file holds them, while a training learns their steps and masks.

A value v of channel c and anchor i is drawn as r((v - o) / s) s + o with s = q_c 2^(class of i) and
o = 0, but for log-scalings the logarithm of the world's scale, as files hold them. Gradients
pass straight through the rounding; that of log q_c is the sum of gradient times (rounded value - v)
(learned step sizes, Esser et al. 2020). A slot is drawn if its logit m is positive; the gradient of
m is that of a factor sigmoid(m) on the slot's opacity (straight-through). `native_decode` rounds
where it gathers; the functions here define its result, and serve other devices.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, number
from scene_experts.core.table import Table
from scene_experts.core.types import Decoded

ROUNDED = ("feature", "log_scaling", "offsets")
"""The columns that are rounded, in the order of their channels."""
KEEP, CLASS = "keep", "class"
"""Column of the logits of masks [N, K], a parameter; column of the classes [N] int64, a fact."""
STEPS = "steps"
"""Name of the learning rate of the steps."""
LOW_CLASS, HIGH_CLASS = -2, 4
"""Least and largest step class: an anchor's steps are 2^class times those of the channels."""
LEAST_SHARE = 1e-3  # of the mean sensitivity, that every channel has
OPEN = 2.0  # logit of a new slot
_SMALLEST, _LARGEST = 1e-30, 1e30  # of a step


def channels(F: int, K: int) -> int:
    """Number of values of an anchor."""
    return F + 6 + 3 * K


def coarse(values: Tensor) -> Tensor:
    """Positive values with four digits, as the header of a file states them."""
    return torch.tensor(
        [float(f"{v:.4g}") for v in values.detach().double().clamp(_SMALLEST, _LARGEST).tolist()], dtype=torch.float64
    ).float()


def find_steps(sensitivity: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
    """Return the steps by column, [C] float32, with which every value adds about 1 to the pictures'
    mean square error, and the classes [N] int64.

    sensitivity: by column, [N, ...], the mean square of the pictures' derivative S. A step is
    sqrt(12 / mean S); the class is the nearest power of 2 to what an anchor's own mean asks for.
    """
    steps, weighted = {}, torch.zeros(0)
    for name in ROUNDED:
        flat = sensitivity[name].double().flatten(1)
        mean = flat.mean(0) if len(flat) else torch.zeros(flat.shape[1], dtype=torch.float64)
        mean = mean.clamp_min(max(float(mean.mean()) * LEAST_SHARE, 1e-30))
        steps[name] = (12 / mean).sqrt().float()
        share = (flat / mean).mean(1) / len(ROUNDED)
        weighted = share if not len(weighted) else weighted + share
    middle = weighted.mean().clamp_min(1e-30) if len(weighted) else torch.ones(())
    found = 0.5 * torch.log2(middle / weighted.clamp_min(1e-12 * float(middle)))
    return steps, found.round().clamp(LOW_CLASS, HIGH_CLASS).long()


class Steps(nn.Module):
    """The steps of all channels, as what is learned: their natural logarithms [F + 6 + 3 K]."""

    log_steps: nn.Parameter
    scale: float  # of the world: trained units per unit of files

    def __init__(self, steps: Tensor, scale: float = 1.0) -> None:
        super().__init__()
        self.scale = scale
        self.log_steps = nn.Parameter(steps.detach().double().log().float())

    @classmethod
    def from_plain(cls, value: Mapping[str, Any], F: int, K: int) -> Steps:
        """Build from the numbers of a checkpoint. Raises Damaged for other numbers of channels and
        for steps out of range."""
        values = value["values"]
        if len(values) != channels(F, K):
            raise Damaged("steps of another number of channels")
        return cls(
            torch.tensor([number(v, "a step", _SMALLEST, _LARGEST) for v in values], dtype=torch.float64),
            number(value["scale"], "the scale of the world", 1e-15, FARTHEST),
        )

    @property
    def stated(self) -> Tensor:
        """The steps [F + 6 + 3 K] as files state them."""
        return coarse(self.log_steps.double().exp())

    def plain(self) -> dict[str, Any]:
        """`stated` and the scale for a checkpoint."""
        return {"values": [float(f"{v:.4g}") for v in self.stated.tolist()], "scale": self.scale}

    def by_column(self, F: int) -> dict[str, Tensor]:
        """`stated` by column: feature [F], log_scaling [6], offsets [3 K]."""
        return dict(zip(ROUNDED, (self.stated[:F], self.stated[F : F + 6], self.stated[F + 6 :])))


@dataclass(frozen=True)
class RowRounding:
    """How the values of N rows are rounded and masked."""

    log_steps: Tensor  # [F + 6 + 3 K]
    classes: Tensor  # [N] int64
    keep: Tensor  # [N, K], logits
    scale: float = 1.0  # of the world

    @property
    def origins(self) -> tuple[float, float, float]:
        """Where the multiples begin, by column."""
        return 0.0, math.log(self.scale), 0.0

    @cached_property
    def steps(self) -> Tensor:
        """[F + 6 + 3 K]"""
        return self.log_steps.detach().exp()

    @cached_property
    def factors(self) -> Tensor:
        """[N], 2^class"""
        return torch.exp2(self.classes.to(self.log_steps.dtype))

    @cached_property
    def open(self) -> Tensor:
        """[N, K] bool: the slots that are drawn."""
        return self.keep.detach() > 0

    def round(self, columns: Sequence[Tensor], rows: Tensor | None = None) -> tuple[Tensor, Tensor, Tensor]:
        """Return feature [A, F], log_scaling [A, 6] and offsets [A, K, 3] of rows [A] (all without),
        rounded. columns: of all rows. Differentiable in the columns and in `log_steps`."""
        F = columns[0].shape[1]
        parts = self.log_steps.split([F, 6, len(self.log_steps) - F - 6])
        factors = self.factors if rows is None else self.factors.index_select(0, rows)
        picked = columns if rows is None else [column.index_select(0, rows) for column in columns]
        feature, log_scaling, offsets = (
            _RoundThrough.apply(v.flatten(1), *given, factors).view_as(v) for v, *given in zip(picked, parts, self.origins)
        )
        return feature, log_scaling, offsets

    def mark(self, decoded: Decoded) -> Decoded:
        """Let gradients of drawn opacities reach the logits of their slots. Leaves out closed
        slots, which `native_decode` has done already."""
        g = decoded.gaussians
        kept = self.open.view(-1).index_select(0, g.source)
        if not bool(kept.all()):
            rows = kept.nonzero().squeeze(1)
            g = type(g)(**{name: value.index_select(0, rows) for name, value in vars(g).items()})
        return replace(decoded, gaussians=replace(g, opacities=_OpenThrough.apply(g.opacities, self.keep, g.source)))


class _RoundThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, value: Tensor, log_steps: Tensor, origin: float, factors: Tensor) -> Tensor:
        step = log_steps.exp() * factors[:, None]
        out = torch.round((value - origin) / step) * step + origin
        ctx.save_for_backward(out - value)
        return out

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple:
        (away,) = ctx.saved_tensors
        return upstream[0], (upstream[0] * away).sum(0), None, None


class _OpenThrough(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, opacities: Tensor, keep: Tensor, source: Tensor) -> Tensor:
        ctx.save_for_backward(opacities, keep, source)
        return opacities.view_as(opacities)

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple:
        opacities, keep, source = ctx.saved_tensors
        share = keep.reshape(-1).index_select(0, source).sigmoid()
        d_keep = torch.zeros_like(keep).view(-1)
        d_keep[source] = upstream[0] * opacities * share * (1 - share)
        return upstream[0], d_keep.view_as(keep), None


def price_masks(keep: Tensor, slot: float, anchor: float) -> Tensor:
    """The gradient [N, K] of the price of all open slots by the logits of masks [N, K], with
    sigmoid(m) in place of the step: each slot pays its own price and its share of its anchor's.
    Closed slots pay what they would cost if they were open."""
    share, opened = keep.sigmoid(), (keep > 0).sum(1, keepdim=True)
    return share * (1 - share) * (slot + anchor / opened.clamp_min(1))


@torch.no_grad()
def settle(table: Table, rounding: RowRounding, steps: Mapping[str, Tensor]) -> Table:
    """Return a table of the values as they are drawn, of the rows with an open slot. steps: by
    column, class 0. The fact `slots` [N, K] says which slots are open.

    Products have the order of `files.anchors.rounding.restore`, so that a file gives the same bits.
    """
    rows, factors = rounding.open.any(1).nonzero().squeeze(1), rounding.factors[:, None]
    columns = {}
    for origin, (name, step) in zip(rounding.origins, steps.items()):
        value = table.params[name].detach()
        whole = torch.round((value.flatten(1) - origin) / step / factors)
        columns[name] = (whole * step * factors + origin).view_as(value)[rows]
    facts = {**table.facts, "slots": rounding.open & table.facts.get("slots", rounding.open)}
    return Table(columns, {name: value[rows] for name, value in facts.items()})
