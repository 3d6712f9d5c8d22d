"""Adam, as of commit da16e27: one Triton kernel for all parameters on CUDA, torch's fused Adam elsewhere."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterable
from typing import Any

import torch
from torch import Tensor

from peer_cuda import device

BLOCK = 1024  # values per program of the kernel


class Adam(torch.optim.Adam):
    """Adam without weight decay. All groups share the betas and eps."""

    def __init__(self, groups: Iterable[dict[str, Any]], betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-15) -> None:
        """groups: {"params": tensors, "lr": float, ...}."""
        groups = list(groups)
        every = [p for group in groups for p in group["params"]]
        self._triton = device.covers(*every)
        fused = all(p.device.type in ("cpu", "cuda") and p.dtype == torch.float32 for p in every)
        super().__init__(groups, lr=0.0, betas=betas, eps=eps, fused=fused)

    @torch.no_grad()
    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """Update every parameter that has a gradient. There is no closure."""
        if not self._triton:
            return super().step(closure)
        calls = [self._prepare(p, group) for group in self.param_groups for p in group["params"] if p.grad is not None]
        if calls:
            self._launch(calls)
        return None

    def _prepare(self, parameter: Tensor, group: dict[str, Any]) -> tuple[Tensor, float, float]:
        """Count the step. Return the parameter, the step size and the root of the second bias correction."""
        state = self.state[parameter]
        if not state:
            state["step"] = torch.zeros((), dtype=torch.float32, device="cpu")
            state["exp_avg"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
            state["exp_avg_sq"] = torch.zeros_like(parameter, memory_format=torch.preserve_format)
        state["step"] = state["step"].cpu()
        state["step"] += 1
        done, (beta1, beta2) = float(state["step"]), group["betas"]
        return parameter, float(group["lr"]) / (1 - beta1**done), (1 - beta2**done) ** 0.5

    def _launch(self, calls: list[tuple[Tensor, float, float]]) -> None:
        places, numbers, alive, programs = [], [], [], 0
        for parameter, step_size, root in calls:
            state, gradient = self.state[parameter], parameter.grad
            assert gradient is not None and parameter.is_contiguous()
            gradient = gradient.contiguous()
            alive.append(gradient)  # kept alive until the launch
            width = max(parameter[:1].numel(), 1) if parameter.dim() else 1
            addresses = [t.data_ptr() for t in (parameter.detach(), gradient, state["exp_avg"], state["exp_avg_sq"])]
            places.append([*addresses, 0, parameter.numel(), width, programs])
            numbers.append([step_size, root])
            programs += -(-parameter.numel() // BLOCK)
        table = torch.cat([torch.tensor(places), torch.tensor(numbers, dtype=torch.float64).view(torch.int64)], dim=1)
        kernel = importlib.import_module("peer_cuda.kernels").adam_step
        group = self.param_groups[0]
        given = (device.upload(table, calls[0][0].device), len(calls), *group["betas"], group["eps"])
        device.launch(kernel, (programs,), *given, B=BLOCK)
