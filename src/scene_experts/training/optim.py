"""Optimisers. On the CPU, Adam is one native call for all parameters, with bit-identical results to
torch's fused Adam. On CUDA it is one Triton kernel.

The state uses torch's names (`exp_avg`, `exp_avg_sq`, `step`), so checkpoints work with both
implementations.
"""

from __future__ import annotations

import ctypes
import importlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from typing import Annotated, Any, ClassVar, Self
from weakref import ref

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.fields import NotNegative, Range
from scene_experts.core.parts import Part, register
from scene_experts.core.transfer import upload
from scene_experts.native import library as native
from scene_experts.native import triton
from scene_experts.native.api import SeAdamTensor

BLOCK = 1024  # values per program of the Triton kernel


@dataclass(frozen=True)
class Optimizer(Part, ABC):
    """Which optimiser moves the parameters; flags under --optimizer. Learning rates are the
    recipe's `rates`."""

    prefix: ClassVar[str] = "optimizer"
    """First word of the names that its state has in checkpoints."""
    moments: ClassVar[tuple[str, ...] | None] = None
    """Names of the tensors of a parameter's shape in its state, which has one more, `step`; None: not
    known, and a checkpoint may have any."""
    by_row: ClassVar[bool] = False
    """Whether `step(rows=...)` of the built optimiser can move some rows of a table only;
    --sparse-adam needs it."""

    def for_batch(self, views: int) -> Self:
        """Return the settings for steps that see `views` views each. The learning rates are
        multiplied by views**batch_rates elsewhere."""
        return self

    @abstractmethod
    def build(self, groups: list[dict[str, Any]]) -> torch.optim.Optimizer:
        """Build the optimiser.

        The training sets "lr" before every step. The state of a parameter may hold only scalar
        tensors and tensors of the parameter's shape. Densification adds and removes rows of the
        latter together with the rows of the table.

        Args:
            groups: {"params": tensors, "name": str, "lr": 0.0, "by_row": whether the parameters are
                columns of the table}.
        """


@register
@dataclass(frozen=True)
class Adam(Optimizer):
    """Adam (Kingma and Ba 2015) without weight decay."""

    prefix = "adam"
    moments = ("exp_avg", "exp_avg_sq")
    by_row = True

    betas: Annotated[tuple[float, float], Range(0, below=1)] = (0.9, 0.999)
    """Decay rates of the first and second moment."""
    eps: NotNegative = 1e-15
    """Term added to the denominator."""

    def for_batch(self, views: int) -> Self:
        """Return the settings with betas^views and eps / sqrt(views) (Zhao et al. 2024, "On scaling
        up 3D Gaussian splatting training")."""
        beta1, beta2 = self.betas
        return replace(self, betas=(beta1**views, beta2**views), eps=self.eps / math.sqrt(views))

    def build(self, groups: list[dict[str, Any]]) -> FusedAdam:
        return FusedAdam(groups, betas=self.betas, eps=self.eps)


class FusedAdam(torch.optim.Adam):
    """Adam without weight decay. All groups share the betas and eps.

    Groups with `by_row` hold parameters [N, ...]. `step(rows=...)` updates only the given rows of
    these parameters. The native step finds numbers that are not finite at no cost: `broken` is then
    the name of the parameter's group, else "".
    """

    broken: str | None = None
    """The parameter that the last step left with a value or moment that is not finite; "": none;
    None: this form does not look."""

    def __init__(self, groups: Iterable[dict[str, Any]], *, betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15) -> None:
        """Create the optimiser.

        Args:
            groups: {"params": tensors, "lr": float, "by_row": bool (default: False), ...}.
            betas: Decay rates of the first and second moment.
            eps: Term added to the denominator.
        """
        groups = [{"by_row": False, **group} for group in groups]
        every = [p for group in groups for p in group["params"]]
        self._native = all(p.device.type == "cpu" and p.dtype == torch.float32 for p in every) and native.load() is not None
        self._table: _Table | None = None
        self._triton = bool(every) and triton.covers(*every)
        fused = all(p.device.type in ("cpu", "cuda") and p.dtype == torch.float32 for p in every)
        super().__init__(groups, lr=0.0, betas=betas, eps=eps, fused=fused)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None, *, rows: Tensor | None = None) -> Any:
        """Update every parameter that has a gradient.

        Args:
            closure: Function that evaluates the loss again and returns it, as in torch.
            rows: [A] int64 without duplicates. Only these rows of the `by_row` groups are updated,
                values and moments both ("sparse" or "selective" Adam). The bias correction counts
                every step. None updates all rows.

        Returns:
            The loss that `closure` returns, or None.
        """
        if rows is None and not self._native and not self._triton:
            return super().step(closure)
        loss = None
        if closure is not None:
            with torch.enable_grad():
                loss = closure()
        if self._triton and rows is None:
            self._step_all()
            return loss
        self._table = None
        calls = [self._prepared(p, group, rows) for group in self.param_groups for p in group["params"] if p.grad is not None]
        if self._native:
            self._call(calls)
        elif self._triton:
            self._launch(calls)
        else:
            for parameter, chosen, step_size, root, group in calls:
                _by_torch(parameter, self.state[parameter], chosen, step_size, root, group)
        return loss

    step.hooked = True  # type: ignore[attr-defined]  # torch puts no record of its own around the step: 25 us a step

    def zero_grad(self, set_to_none: bool = True) -> None:
        """Remove the gradients, or clear them, as torch does in ten times as long."""
        if not set_to_none:
            return super().zero_grad(set_to_none=False)
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None
        return None

    def _prepared(self, parameter: Tensor, group: dict[str, Any], rows: Tensor | None) -> tuple[Tensor, Tensor | None, float, float, dict]:
        """Count the step. Return (parameter, its rows or None for all, step size, root of the
        second bias correction, group)."""
        state = self.state[parameter]
        if not state:
            self._begin(parameter)
        (beta1, beta2) = group["betas"]
        if self._triton:  # reading a counter on the device would wait for it; a checkpoint may have put it there
            if state["step"].device.type != "cpu":
                state["step"] = state["step"].cpu()
            counter = state["step"].numpy()  # a tenth of the time of a tensor's operators
            counter += 1
            done = float(counter)
        else:
            state["step"] += 1
            done = float(state["step"])
        chosen = rows if group["by_row"] else None
        return parameter, chosen, float(group["lr"]) / (1 - beta1**done), (1 - beta2**done) ** 0.5, group

    def _begin(self, parameter: Tensor) -> None:
        state = self.state[parameter]
        state["step"] = torch.zeros((), dtype=torch.float32, device="cpu" if self._triton else parameter.device)
        state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)

    def _call(self, calls: list[tuple[Tensor, Tensor | None, float, float, dict]]) -> None:
        tensors, alive = (SeAdamTensor * len(calls))(), []
        for to, (parameter, rows, step_size, root, _) in zip(tensors, calls):
            state, gradient = self.state[parameter], parameter.grad
            assert gradient is not None
            gradient = gradient.contiguous()
            rows = None if rows is None else rows.contiguous()
            alive += [gradient, rows]  # kept alive until the call returns
            to.value, to.gradient, to.rows = (native.pointer(t).value for t in (parameter.detach(), gradient, rows))
            to.first, to.second = native.pointer(state["exp_avg"]).value, native.pointer(state["exp_avg_sq"]).value
            to.count, to.width = (parameter.numel(), 1) if rows is None else (len(rows), parameter[:1].numel())
            to.step_size, to.root = step_size, root
        group = self.param_groups[0]
        bad = native.require().se_adam_step(tensors, len(calls), *group["betas"], group["eps"], native.count_threads())
        self.broken = "" if bad < 0 else str(calls[bad][-1].get("name", bad))

    def _launch(self, calls: list[tuple[Tensor, Tensor | None, float, float, dict]]) -> None:
        """Run the step of these parameters as one kernel."""
        table = _Table([(p, p.grad, rows, self.state[p]) for p, rows, *_ in calls if p.grad is not None])
        table.numbers[:] = [numbers[2:4] for numbers in calls]
        self._launch_table(table)

    def _step_all(self) -> None:
        """Count and run the step of all parameters that have a gradient, all of their rows, as one
        kernel. What stays from step to step is kept: the host is what this takes time of."""
        used = [(p, group) for group in self.param_groups for p in group["params"] if p.grad is not None]
        table = self._table
        if table is None or not table.fits(used, self.state):
            for parameter, _ in used:
                if not self.state[parameter]:
                    self._begin(parameter)
                elif self.state[parameter]["step"].device.type != "cpu":  # a checkpoint may have put it there
                    self.state[parameter]["step"] = self.state[parameter]["step"].cpu()
            table = self._table = _Table([(p, p.grad, None, self.state[p]) for p, _ in used])  # type: ignore[misc]
        beta1, beta2 = self.param_groups[0]["betas"]
        ages = table.count()
        if table.together and ages:
            first, root = 1 - beta1 ** ages[0], (1 - beta2 ** ages[0]) ** 0.5
            numbers = [(group["lr"] / first, root) for _, group in used]
        else:
            numbers = [(group["lr"] / (1 - beta1**age), (1 - beta2**age) ** 0.5) for age, (_, group) in zip(ages, used)]
        if numbers:
            table.numbers[:] = numbers
        self._launch_table(table)

    def _launch_table(self, table: _Table) -> None:
        if not table.programs:
            return
        (beta1, beta2), eps = self.param_groups[0]["betas"], self.param_groups[0]["eps"]
        on_device = upload(torch.from_numpy(table.values), self.param_groups[0]["params"][0].device)
        _kernel()((table.programs,), on_device, len(table.values), beta2, 1 - beta1, 1 - beta2, eps)
        table.alive = []


class _Table:
    """What the kernel reads about each parameter, see `triton_adam.step`: addresses and sizes, which
    often stay from step to step, and two numbers, which change. It keeps no tensor alive
    after its first launch."""

    def __init__(self, items: list[tuple[Tensor, Tensor, Tensor | None, dict[str, Tensor]]]) -> None:
        """items: parameter, gradient, rows to update (None: all) and state of each."""
        places, self.programs, self.alive = [], 0, []
        self.known = [tuple(map(ref, (p, g, state["exp_avg"], state["step"]))) for p, g, _, state in items]
        self.lasts = all(gradient.is_contiguous() for _, gradient, *_ in items)
        self.counters = [ctypes.c_float.from_address(state["step"].data_ptr()) for *_, state in items]  # on the CPU
        self.together = len({counter.value for counter in self.counters}) == 1
        for parameter, gradient, rows, state in items:
            assert parameter.is_contiguous()
            gradient, rows = gradient.contiguous(), None if rows is None else rows.contiguous()
            self.alive += [gradient, rows]
            width = max(parameter[:1].numel(), 1) if parameter.dim() else 1
            count = parameter.numel() if rows is None else len(rows) * width
            addresses = [t.data_ptr() for t in (parameter, gradient, state["exp_avg"], state["exp_avg_sq"])]
            places.append([*addresses, 0 if rows is None else rows.data_ptr(), count, width, self.programs])
            self.programs += -(-count // BLOCK)
        self.values = np.empty((len(items), 10), np.int64)
        self.values[:, :8] = np.array(places, np.int64).reshape(-1, 8)
        self.numbers = self.values[:, 8:].view(np.float64)

    def count(self) -> list[float]:
        """Count a step of every parameter. Returns their numbers of steps. Call it only if the table
        `fits`: a counter is written where its tensor lies."""
        if self.together:
            done = self.counters[0].value + 1
            for counter in self.counters:
                counter.value = done
            return [done]
        for counter in self.counters:
            counter.value += 1
        return [counter.value for counter in self.counters]

    def fits(self, used: list[tuple[Tensor, dict[str, Any]]], state: Any) -> bool:
        """Whether the parameters, their gradients and their states are those of this table."""
        if not self.lasts or len(used) != len(self.known):
            return False
        for (parameter, _), (own, gradient, first, step) in zip(used, self.known):
            if parameter is not own() or parameter.grad is not gradient():
                return False
            found = state[parameter]
            if found.get("exp_avg") is not first() or found.get("step") is not step():
                return False
        return True


def _kernel() -> triton.Launch:
    return _kernel_of(BLOCK)


@cache
def _kernel_of(block: int) -> triton.Launch:
    return triton.Launch(importlib.import_module("scene_experts.training.triton_adam").step, B=block)


def _by_torch(parameter: Tensor, state: dict[str, Tensor], rows: Tensor | None, step_size: float, root: float, group: dict) -> None:
    """Run the same step in plain torch, on any device and with any dtype."""
    beta1, beta2 = group["betas"]
    gradient = parameter.grad
    assert gradient is not None
    if rows is None:
        value, first, second = parameter, state["exp_avg"], state["exp_avg_sq"]
    else:
        value, gradient, first, second = (t.index_select(0, rows) for t in (parameter, gradient, state["exp_avg"], state["exp_avg_sq"]))
    first.lerp_(gradient, 1 - beta1)
    second.mul_(beta2).addcmul_(gradient, gradient, value=1 - beta2)
    value.addcdiv_(first, (second.sqrt() / root).add_(group["eps"]), value=-step_size)
    if rows is not None:
        for whole, part in ((parameter, value), (state["exp_avg"], first), (state["exp_avg_sq"], second)):
            whole.index_copy_(0, rows, part)
