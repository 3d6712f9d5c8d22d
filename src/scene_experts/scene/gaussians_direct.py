"""Views of explicit Gaussians on CUDA without autograd: two Triton kernels, and one array that keeps
the slopes of all columns. `GaussianScene.forward` with autograd is the reference."""

from __future__ import annotations

import importlib
from functools import cache
from typing import Any, Protocol

from torch import Tensor

from scene_experts.core.slopes import GaussianSlopes, PullScene, Regularisers, allocate
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
        self.slopes, parts = allocate(self.columns[0], [tuple(p.shape) for p in params])
        self.grads = list(zip(params, parts))

    def draw(self, camera: Camera, step: int, cull: Cull) -> tuple[Decoded, PullScene]:
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

        def pull(slopes: GaussianSlopes, terms: Regularisers) -> None:
            for parameter, gradient in self.grads:  # of an earlier view of the batch
                if parameter.grad is gradient:
                    parameter.grad = gradient.clone()
            self.slopes.zero_()
            by = (slopes.means, slopes.quats, slopes.scales, slopes.opacities, slopes.colors)
            given = (rows, means, quats, rest, position, g.quats, g.scales, g.opacities, g.colors, *by)
            to = [gradient for _, gradient in self.grads]
            if A:
                _launch("pull_back", *sizes)(grid, *given, *to, A, terms.volume / A)
            if terms.mean_opacity:
                opacity, share = raw.sigmoid(), terms.mean_opacity / max(raw.numel(), 1)
                to[3].add_(opacity, alpha=share).addcmul_(opacity, opacity, value=-share)
            if terms.mean_size:
                to[1].add_(log_scales.exp(), alpha=terms.mean_size / max(log_scales.numel(), 1))
            for parameter, gradient in self.grads:
                parameter.grad = gradient if parameter.grad is None else parameter.grad + gradient

        return Decoded(g, rows, None, {}, population=(raw, log_scales)), pull


@cache
def _launch(name: str, rest: int, count: int) -> Any:
    kernels = importlib.import_module("scene_experts.scene.triton_gaussians")
    return triton.Launch(getattr(kernels, name), REST=rest, COUNT=count, B=BLOCK)
