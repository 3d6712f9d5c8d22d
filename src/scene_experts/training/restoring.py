"""Restores what a checkpoint has beside its scene: the state of the optimiser and the statistics of
densification. Compiled code writes to them without further checks, so those of a foreign checkpoint
are compared with their parameters and rows first."""

from __future__ import annotations

import torch
from torch import Tensor

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import all_finite
from scene_experts.scene import Scene
from scene_experts.training.optim import Optimizer


def restore_moments(settings: Optimizer, optimizer: torch.optim.Optimizer, tensors: dict[str, Tensor]) -> None:
    """Give an optimiser the state that a checkpoint with these named tensors has. Raises Damaged
    unless each parameter has either no state or tensors with the names of `settings`, scalars or of
    its shape and type, all of them finite."""
    for group in optimizer.param_groups:
        for i, parameter in enumerate(group["params"]):
            prefix = f"{settings.prefix}.{group['name']}.{i}."
            state = {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}
            if not state:
                continue
            if settings.moments is not None and state.keys() != {"step", *settings.moments}:
                raise Damaged(f"{', '.join(sorted(state))} in {prefix}* where step, {', '.join(settings.moments)} are expected")
            for name, value in state.items():
                shapes = [parameter.shape] if name in (settings.moments or ()) else [()] if settings.moments else [(), parameter.shape]
                if value.shape not in shapes or value.dtype not in (parameter.dtype, *([] if value.dim() else [torch.float32])):
                    expected = f"{list(shapes[0])} and type {parameter.dtype}"
                    raise Damaged(f"{prefix}{name} of shape {list(value.shape)} and type {value.dtype} where {expected} are expected")
                if not all_finite(value):
                    raise Damaged(f"values that are not finite in {prefix}{name}")
            optimizer.state[parameter] = {name: value.to(parameter.device) for name, value in state.items()}


def restore_stats(scene: Scene, tensors: dict[str, Tensor]) -> None:
    """Give the table of a scene the statistics that a checkpoint has. Raises Damaged unless each has
    one number for each row or slot."""
    rows = len(scene.table)
    slots = (rows, scene.K)
    found = {name.removeprefix("stats."): value for name, value in tensors.items() if name.startswith("stats.")}
    for name, value in found.items():
        if tuple(value.shape) not in ((rows,), slots) or not value.is_floating_point():
            raise Damaged(f"stats.{name} of shape {list(value.shape)} and type {value.dtype} for {rows:,} rows")
    scene.table.stats = found
