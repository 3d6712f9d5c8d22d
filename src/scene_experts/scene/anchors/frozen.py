"""A trained anchor scene prepared for drawing: values that do not depend on the camera are computed
once.

Routing depends only on the anchor, so the chosen experts of each anchor and their weights are
stored. The Gaussians are the same bits as those of the native decode, on the CPU and on CUDA.
Symbols as in `types.py`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor

from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Routing
from scene_experts.scene import Cull
from scene_experts.scene.anchors import native_decode, triton_decode
from scene_experts.scene.anchors.appearance import Codes, fold
from scene_experts.scene.anchors.mlp import ATTRIBUTES, HeadWeights
from scene_experts.scene.anchors.select import Selector, drop_masked, fade_opacities, visible_rows
from scene_experts.scene.anchors.smoothing import smooth


class Drawn(Protocol):
    """What is needed of the scene, an `AnchorScene`."""

    table: Table
    config: Any
    extent: float
    codes: Codes | None
    select: Selector

    @property
    def K(self) -> int: ...

    def route_outside(self, weights: dict[str, HeadWeights], rows: Tensor, step: int) -> dict[str, tuple[Routing, Tensor]]: ...


@dataclass(frozen=True)
class Kept:
    """Camera-independent routing of one attribute."""

    gates: Tensor | None  # [N, E], while dense
    chosen: Tensor | None  # [N, k] int64
    chosen_weight: Tensor | None  # [N, k]

    @property
    def bytes(self) -> int:
        return sum(t.numel() * t.element_size() for t in (self.gates, self.chosen, self.chosen_weight) if t is not None)


class Frozen:
    """Draws a scene at one step without gradients. The result contains no routing
    (`AnchorScene.routing` returns it)."""

    scene: Drawn
    step: int
    columns: list[Tensor]
    xyz: Tensor
    scales: Tensor
    with_dist: dict[str, bool]
    weights: dict[str, HeadWeights]
    kept: tuple[Kept, ...]

    @torch.no_grad()
    def __init__(self, scene: Drawn, weights: dict[str, HeadWeights], step: int) -> None:
        self.scene, self.step = scene, step
        p = scene.table.params
        self.columns = [p[name].detach().contiguous() for name in ("feature", "log_scaling", "offsets")]
        self.xyz = scene.table.facts["xyz"].contiguous()
        self.scales = self.columns[1][:, :3].contiguous().exp()
        self.with_dist = {a: a in scene.config.add_dist for a in ATTRIBUTES}
        self.weights = {a: _detach(w) for a, w in weights.items()}
        self.kept = self._keep()

    @property
    def bytes(self) -> int:
        """Memory in bytes, in addition to that of the scene."""
        return sum(kept.bytes for kept in self.kept) + self.scales.numel() * 4

    @torch.no_grad()
    def __call__(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        """Do the same as `AnchorScene.forward`. Raises ValueError for another step or another mode
        than DRAW."""
        if mode is not Mode.DRAW or step != self.step:
            raise ValueError(f"expected to draw step {self.step}, found {mode} at step {step}; call `Scene.frozen` again")
        scene = self.scene
        rows = visible_rows(scene.select(scene.table, camera, step, mode), self.xyz, self.scales, camera, cull)
        decoded = self.decode(rows, camera)
        decoded = fade_opacities(decoded, scene.select.fade(scene.table, rows, camera, step, mode), len(scene.table), scene.K)
        decoded = drop_masked(decoded, scene.table.facts.get("slots"))
        return smooth(decoded, scene.table.facts.get("interval"), scene.config.smoothing, scene.K)

    @torch.no_grad()
    def decode(self, rows: Tensor, camera: Camera) -> Decoded:
        """Return the Gaussians of rows [A], as `AnchorScene.decode` does."""
        call, alive = self._call(rows, camera.position, self._at(camera))
        call.frozen = 1
        for head, kept in zip(call.heads, self.kept):
            native_decode.set_pointers(head, gates=kept.gates, chosen=kept.chosen, chosen_weight=kept.chosen_weight)
        made, raw, _, _ = native_decode.run(call)
        del alive
        return Decoded(Gaussians(*made), rows, raw, {})

    def _at(self, camera: Camera) -> dict[str, HeadWeights]:
        """Return the heads for `camera`. Its appearance code, if the scene has codes, is added to
        the first bias of the colour network."""
        codes = self.scene.codes
        return self.weights if codes is None else {**self.weights, "color": _detach(fold(self.weights["color"], codes(camera, Mode.DRAW)))}

    def _routers(self) -> dict[str, HeadWeights]:
        """Return heads that route as those of every camera do: with any code, because the routing
        does not depend on it."""
        codes = self.scene.codes
        return self.weights if codes is None else {**self.weights, "color": _detach(fold(self.weights["color"], codes.table[0]))}

    def _call(self, rows: Tensor, position: Tensor, heads: dict[str, HeadWeights]) -> tuple:
        """Return the arguments of the library and the tensors that they point to."""
        plan = native_decode.make_plan(rows, self.xyz, position, heads, self.with_dist, self.scene.extent, False)
        weights = [getattr(heads[a], name) for a in ATTRIBUTES for name in native_decode.TENSORS]
        return native_decode.make_call(plan, self.columns, weights), (plan, weights)

    def _keep(self) -> tuple[Kept, ...]:
        heads, N, nowhere = self._routers(), len(self.xyz), torch.zeros(3)
        call, alive = self._call(torch.arange(N), nowhere, heads)
        routed = [h.router_w is not None for h in heads.values()]
        outside = self.scene.route_outside(heads, torch.arange(N), self.step)
        gates = [torch.empty(N, head.E) if r else None for r, head in zip(routed, call.heads)]
        chosen = [torch.empty(N, head.k, dtype=torch.int64) if r and head.k else None for r, head in zip(routed, call.heads)]
        chosen_weight = [torch.empty(N, head.k) if r and head.k else None for r, head in zip(routed, call.heads)]
        native_decode.set_routing(call, gates, chosen, chosen_weight)
        native_decode.route(call)
        del alive
        kept = {a: Kept(None if c is not None else g, c, m) for a, g, c, m in zip(ATTRIBUTES, gates, chosen, chosen_weight)}
        for a, (routing, weight) in outside.items():
            chosen = routing.chosen
            kept[a] = Kept(weight, None, None) if chosen is None else Kept(None, chosen.contiguous(), weight.contiguous())
        return tuple(kept.values())


def _detach(w: HeadWeights) -> HeadWeights:
    values: dict[str, Any] = {name: value.detach().contiguous() for name, value in vars(w).items() if isinstance(value, Tensor)}
    return replace(w, **values)


class FrozenCuda(Frozen):
    """The same on CUDA, with the Triton kernels."""

    kept: triton_decode.Routes  # type: ignore[assignment]

    @property
    def bytes(self) -> int:
        return self.kept.bytes + self.scales.numel() * 4

    @torch.no_grad()
    def decode(self, rows: Tensor, camera: Camera) -> Decoded:
        gaussians, raw = self.kept.decode(rows, camera.position, self._at(camera))
        return Decoded(gaussians, rows, raw, {})

    def _keep(self) -> triton_decode.Routes:  # type: ignore[override]
        heads = self._routers()
        outside = self.scene.route_outside(heads, torch.arange(len(self.xyz), device=self.xyz.device), self.step)
        return triton_decode.Routes(self.xyz, self.columns, heads, self.with_dist, self.scene.extent, outside)
