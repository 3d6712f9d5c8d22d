"""The statistics of an iteration that a training shows and writes down."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.types import Decoded, Render, Routing
from scene_experts.strategy import Edit
from scene_experts.training.events import Stepped
from scene_experts.training.losses import load_dense, load_sparse
from scene_experts.training.state import Training

ROUTED = 16_384  # anchors sampled for the routing statistics; the shares are within 0.5 % of those of all anchors


@dataclass(frozen=True)
class Iteration:
    """Inputs and results of the last view of a batch that this process drew, and what densification
    did after the batch."""

    decoded: Decoded
    render: Render
    terms: Mapping[str, Tensor]  # by name, weighted; computed when they are read where autograd did not need them
    target: Tensor  # [H, W, 3]
    mask: Tensor | None  # [H, W]
    edits: tuple[tuple[int, Edit], ...] = ()  # iteration and result of each densification step


@torch.no_grad()
def measure_step(training: Training, done: Iteration) -> Stepped:
    """Compute the statistics of the last iteration."""
    decoded = done.decoded
    error = done.render.image.clamp(0, 1).sub_(done.target).square_()
    counts = error.new_tensor(error[..., 0].numel()) if done.mask is None else done.mask.sum()
    mse = float(error.mean() if done.mask is None else (error.mean(2) * done.mask).sum() / counts.clamp_min(1e-12))
    raw = decoded.raw_opacity
    balance, entropy = {}, {}
    for attribute, r in decoded.routing.items():
        A, E = r.gates.shape
        balance[attribute] = float(load_dense(r.gates) if r.chosen is None else load_sparse(r.gates, r.chosen) / r.chosen.shape[1])
        entropy[attribute] = float(torch.special.entr(r.gates).sum()) / max(A, 1) / math.log(E)
    scene = training.scene.routing(training.step, ROUTED) if decoded.routing else {}
    return Stepped(
        step=training.step,
        terms={k: float(v) for k, v in done.terms.items()},
        psnr=-10.0 * math.log10(max(mse, 1e-10)) if counts > 0 else None,
        anchors=training.scene.table.total,
        visible=len(decoded.rows),
        gaussians=len(decoded.gaussians),
        active=float((raw > 0).float().mean()) if raw is not None and raw.numel() else 0.0,
        seconds=training.clock.seconds,
        routing={attribute: use(r) for attribute, r in decoded.routing.items()},
        balance=balance,
        entropy=entropy,
        scene_routing={attribute: use(r) for attribute, r in scene.items()},
        scene_gates={attribute: use(Routing(r.gates, None)) for attribute, r in scene.items()},
    )


def use(r: Routing) -> list[float]:
    """Return each expert's share of the assignments, or its mean gate while routing is dense,
    [E]."""
    A, E = r.gates.shape
    share = r.gates.sum(0) / max(A, 1) if r.chosen is None else torch.bincount(r.chosen.reshape(-1), minlength=E) / max(r.chosen.numel(), 1)
    return [round(float(c), 4) for c in share]


def without_graph(value: Any) -> Any:
    """Return the same value with every tensor detached, so that the buffers of the autograd graph
    can be freed."""
    if isinstance(value, Tensor):
        return value.detach()
    if isinstance(value, (tuple, list)):
        return type(value)(without_graph(item) for item in value)
    if isinstance(value, dict):
        return {name: without_graph(item) for name, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: without_graph(getattr(value, f.name)) for f in fields(value) if f.init})
    return value
