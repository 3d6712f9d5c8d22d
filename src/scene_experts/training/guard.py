"""Stop a training whose numbers are no longer finite, before a checkpoint is replaced by a broken
one.

Native Adam reports such numbers after every step, in the pass that it makes anyway. For every other
optimiser the parameters and the optimiser's state are scanned every EVERY iterations: what is not
finite in a moment stays so, and is found later. Every save scans the whole state first.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import RunError
from scene_experts.core.schedule import passes
from scene_experts.training.optim import FusedAdam

EVERY = 100  # iterations between scans where the optimiser does not report


def find_broken(optimizer: torch.optim.Optimizer, step: int, views: int = 1) -> str:
    """Return the name of a parameter that the last `views` iterations left with a value or state
    that is not finite, else "".

    The groups of `optimizer` have a "name". `FusedAdam` reports the name after every step.
    """
    reported = optimizer.broken if isinstance(optimizer, FusedAdam) else None
    if reported is not None or not passes(step, views, EVERY):
        return reported or ""
    return next((str(name) for name, tensors in _states(optimizer) if not are_finite(tensors)), "")


def check_state(tensors: dict[str, Tensor], step: int, folder: Path | None) -> None:
    """Raise RunError, which names the tensor, if a tensor of the state to be saved is not
    finite."""
    for name, tensor in tensors.items():
        if not are_finite([tensor]):
            raise RunError(explain(f"'{name}'", step, folder))


def check_finite(step: int, parts: Mapping[str, Tensor]) -> None:
    """Check the losses before saving. Raises RunError if one is not finite, so that the last valid
    checkpoint is kept."""
    bad = [name for name, value in parts.items() if not math.isfinite(value)]
    if bad:
        raise RunError(
            f"expected finite losses, found {', '.join(bad)} = {float(parts[bad[0]])} at iteration {step}; "
            "the last checkpoint is intact: look at the capture with `scene-experts info`, or lower the learning rates (--rates...)"
        )


def explain(what: str, step: int, folder: Path | None) -> str:
    """Return the sentence of the error: what is not finite, which state is left, and what to do.

    folder: Folder of the checkpoints; None if nothing is saved.
    """
    saved = [int(digits) for path in (folder or Path()).glob("ckpt_*.safetensors") if folder and (digits := path.stem[5:]).isdecimal()]
    kept = f"the checkpoint of iteration {max(saved)} is intact" if saved else "nothing was saved yet"
    return (
        f"expected finite numbers, found NaN or infinity in {what} at iteration {step}; {kept}: "
        "look at the capture with `scene-experts info`, or train again with lower learning rates (--rates...)"
    )


@torch.no_grad()
def are_finite(tensors: Iterable[Tensor]) -> bool:
    """Return whether every number of the floating-point tensors is finite. Reads each tensor once
    and allocates nothing of its size."""
    ends = [torch.stack(torch.aminmax(t.detach())) for t in tensors if t.is_floating_point() and t.numel()]
    return all(bool(end.isfinite().all()) for end in ends)  # all scans are queued before the first answer is waited for


def _states(optimizer: torch.optim.Optimizer) -> Iterable[tuple[object, list[Tensor]]]:
    """Yield the name of each group with its parameters and the tensors of their state."""
    for number, group in enumerate(optimizer.param_groups):
        state = [value for p in group["params"] for value in optimizer.state.get(p, {}).values() if isinstance(value, Tensor)]
        yield group.get("name", number), [*group["params"], *state]
