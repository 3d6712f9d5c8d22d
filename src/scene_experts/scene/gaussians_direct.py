"""Views of explicit Gaussians on CUDA without autograd: two Triton kernels, and one array that keeps
the gradients of all columns. `GaussianScene.forward` with autograd is the reference."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any, Protocol

from torch import Tensor

from scene_experts.core.gradients import BackwardScene, GaussianGradients, Regularisers, ReusedGradients, allocate
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians
from scene_experts.native import triton
from scene_experts.scene import Cull

BLOCK = 128  # Gaussians per program
COLUMNS = ("means", "log_scales", "quats", "raw_opacity", "sh_dc", "sh_rest")


class ExplicitScene(Protocol):
    """What is used of a `GaussianScene`."""

    table: Table

    def visible(self, camera: Camera, cull: Cull) -> Tensor: ...
    def degree(self, step: int) -> int: ...


class DirectGaussians:
    """Draws views of a scene as long as its rows do not change."""

    def __init__(self, scene: ExplicitScene) -> None:
        self.scene = scene
        params = [scene.table.params[name] for name in COLUMNS]
        self.columns = [p.detach() for p in params]
        self.gradients, parts = allocate(self.columns[0], [tuple(p.shape) for p in params])
        self.grads, self.parts = ReusedGradients(zip(params, parts)), parts

    def draw(self, camera: Camera, step: int, cull: Cull) -> tuple[Decoded, BackwardScene]:
        """See `DirectScene.draw`."""
        means, log_scales, quats, raw, dc, rest = self.columns
        rows = self.scene.visible(camera, cull)
        A, position = rows.shape[0], camera.position.to(means)
        new = means.new_empty
        g = Gaussians(new(A, 3), new(A, 4), new(A, 3), new(A), new(A, 3), rows)
        sizes = (rest.shape[1], (self.scene.degree(step) + 1) ** 2)
        grid = (-(-A // BLOCK),)
        out = (g.means, g.quats, g.scales, g.opacities, g.colors)
        if A:
            _launch("decode", *sizes)(grid, rows, means, log_scales, quats, raw, dc, rest, position, *out, A)

        def backward(gradients: GaussianGradients, terms: Regularisers) -> None:
            self.grads.release()
            self.gradients.zero_()
            by = (gradients.means, gradients.quats, gradients.scales, gradients.opacities, gradients.colors)
            given = (rows, means, quats, rest, position, g.quats, g.scales, g.opacities, g.colors, *by)
            to = self.parts
            if A:
                _launch("backward", *sizes)(grid, *given, *to, A, terms.volume / A)
            if terms.mean_opacity:
                opacity, share = raw.sigmoid(), terms.mean_opacity / max(raw.numel(), 1)
                to[3].add_(opacity, alpha=share).addcmul_(opacity, opacity, value=-share)
            if terms.mean_size:
                to[1].add_(log_scales.exp(), alpha=terms.mean_size / max(log_scales.numel(), 1))
            self.grads.add()

        return Decoded(g, rows, None, {}, population=(raw, log_scales)), backward


@cache
def _launch(name: str, rest: int, count: int) -> Any:
    kernels = importlib.import_module("scene_experts.scene.triton_gaussians")
    return triton.Launch(getattr(kernels, name), REST=rest, COUNT=count, B=BLOCK)
