"""Views of an anchor scene on CUDA without autograd: the halves of `triton_decode` are called one
after the other, and the gradients of all parameters lie in one array that is kept.

`AnchorScene.forward` with autograd is the reference. What few scenes have, and what acts on drawn
Gaussians alone (fading levels, masked slots, smoothing), goes through autograd here too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor, nn

from scene_experts.core.gradients import BackwardScene, GaussianGradients, Regularisers, ReusedGradients, allocate
from scene_experts.core.lazy import LazyMapping
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Mode, Routing
from scene_experts.scene import Cull
from scene_experts.scene.anchors.appearance import Codes, fold
from scene_experts.scene.anchors.mlp import ATTRIBUTES, Head, HeadWeights
from scene_experts.scene.anchors.triton_decode import DecodeGradients, DrawnView
from scene_experts.scene.anchors.triton_decode import backward as decode_backward
from scene_experts.scene.anchors.triton_decode import draw as draw_anchors
from scene_experts.scene.anchors.triton_networks import LOCAL, NETWORK, AnchorView, KernelNetworks
from scene_experts.scene.anchors.triton_routing import RoutingArrays, find_load_gradients, route

COLUMNS = ("feature", "log_scaling", "offsets")
PARTS = ("means", "quats", "scales", "opacities", "colors")


class DecodedScene(Protocol):
    """What is used of an `AnchorScene`."""

    table: Table
    config: Any
    extent: float
    codes: Codes | None
    heads: Mapping[str, Head]

    @property
    def changes_drawn(self) -> bool: ...
    def choose(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> tuple[Tensor, Camera]: ...
    def finish(self, decoded: Decoded, camera: Camera, step: int, mode: Mode) -> Decoded: ...


@dataclass(frozen=True)
class Own:
    """A tensor that the kernels take, as some of the leading entries of a parameter."""

    parameter: nn.Parameter
    first: int
    count: int

    @classmethod
    def of(cls, tensor: Tensor) -> Own | None:
        """Return where a tensor lies, or None if it is computed from parameters."""
        base = tensor if isinstance(tensor, nn.Parameter) else tensor._base
        if not isinstance(base, nn.Parameter) or base.shape[1:] != tensor.shape[1:] or not tensor.is_contiguous():
            return None
        return cls(base, tensor.storage_offset() // max(base[:1].numel(), 1), len(tensor))

    @property
    def whole(self) -> bool:
        return self.count == len(self.parameter)

    def of_whole(self, like: Tensor) -> Tensor:
        """Return the same entries of a tensor of the parameter's shape."""
        return like[self.first : self.first + self.count]


def explain_uncovered(weights: dict[str, HeadWeights]) -> str:
    """Return why views of these networks need autograd, or ""."""
    for attribute, w in weights.items():
        if w.routed_outside:
            return f"a router of {attribute} without a kernel"
        if any(Own.of(t) is None for t in _tensors(w)):
            return f"networks of {attribute} that are computed from other tensors"
    return ""


def _tensors(w: HeadWeights) -> list[Tensor]:
    return [t for t in (w.w1, w.b1, w.w2, w.b2, w.router_w, w.router_b) if t is not None]


class DirectAnchors:
    """Draws views of a scene as long as its rows and the phase of its networks do not change."""

    def __init__(self, scene: DecodedScene, weights: dict[str, HeadWeights], load: bool) -> None:
        """weights: those of the phase, see `explain_uncovered`. load: whether the loss has the
        load-balancing term."""
        table, config = scene.table, scene.config
        self.scene, self.codes, self.color = scene, scene.codes, weights["color"]
        self.params = [table.params[name] for name in COLUMNS]
        self.columns = [p.detach() for p in self.params]
        given = {**weights, "color": fold(weights["color"], self.codes.table[0])} if self.codes else weights
        with_dist = {a: a in config.add_dist for a in ATTRIBUTES}
        self.nets = KernelNetworks(given, with_dist, config.F, config.K, constant=not load)
        self.weights = [getattr(weights[a], name).detach() for a in ATTRIBUTES for name in NETWORK]
        self.routers = [getattr(weights[a], name) for a in ATTRIBUTES for name in ("router_w", "router_b")]
        shapes = [tuple(p.shape) for p in self.params]
        self.gradients, self.into = allocate(self.columns[0], shapes)
        self.flat = self.columns[0].new_zeros(self.nets.width)  # apart: the gradients of networks outlive the columns
        self.moves: tuple[list[Tensor], list[Tensor]] = [], []  # their parts, and where the kernels write these
        self.grads = ReusedGradients([*zip(self.params, self.into), *self._place(weights)])
        self.kept: tuple[Any, RoutingArrays] | None = None  # routing of the table that nothing trains

    def _place(self, weights: dict[str, HeadWeights]) -> list[tuple[nn.Parameter, Tensor]]:
        """Return each parameter of the networks with the tensor of its gradient."""
        found: list[tuple[nn.Parameter, Tensor]] = []
        parts = iter(self.nets.split(self.flat))
        given = [(getattr(weights[a], name), next(parts)) for a in ATTRIBUTES for name in NETWORK]
        given += [(t, next(parts)) for t in self.routers if t is not None]
        folded = (self.color.w1, self.color.b1) if self.codes else ()
        self.folded = [part for t, part in given if any(t is f for f in folded)]
        whole: dict[nn.Parameter, Tensor] = {}
        for tensor, part in given:
            own = Own.of(tensor)
            assert own is not None
            changed = any(tensor is f for f in folded)
            if not own.parameter.requires_grad and not changed:
                continue
            if own.whole and not changed:
                found.append((own.parameter, part))
                continue
            whole[own.parameter] = torch.zeros_like(own.parameter)
            if not changed:
                self.moves[0].append(own.of_whole(whole[own.parameter]))
                self.moves[1].append(part)
        if self.codes:
            self.unfolded = [self._part(t, whole) for t in folded]
            whole[self.codes.table] = self.d_codes = torch.zeros_like(self.codes.table)
        return [*found, *whole.items()]

    def _part(self, tensor: Tensor, whole: dict[nn.Parameter, Tensor]) -> Tensor:
        own = Own.of(tensor)
        assert own is not None
        return own.of_whole(whole[own.parameter])

    def draw(self, camera: Camera, step: int, cull: Cull) -> tuple[Decoded, BackwardScene]:
        """Decode a training view, as `AnchorScene.forward` in `Mode.TRAIN`. Returns it with the
        function that adds the gradients of the parameters to their `grad`. Both run without autograd's
        recording."""
        scene, weights, code = self.scene, self.weights, None
        rows, seen_from = scene.choose(camera, step, Mode.TRAIN, cull)
        if self.codes is not None:
            code = self.codes(camera, Mode.TRAIN).detach()
            color = fold(self.color, code)
            weights = [*weights[:8], color.w1.contiguous(), color.b1.contiguous(), *weights[10:]]
        xyz = scene.table.facts["xyz"]
        position = seen_from.position.to(xyz.device)
        view = AnchorView(self.nets, rows, xyz, position, self.columns, weights, self.routers, scene.extent)
        drawn = draw_anchors(view, self._route(view))
        decoded = Decoded(drawn.gaussians, rows, drawn.raw, LazyMapping(self._routing_of(drawn, step)))
        shown, graph = self._finish(decoded, camera, step)

        def backward(gradients: GaussianGradients, terms: Regularisers) -> None:
            self.grads.release()
            self.gradients.zero_()
            self._backward(drawn, shown, graph, gradients, terms)
            if self.moves[0]:
                torch._foreach_copy_(*self.moves)  # pyright: ignore[reportPrivateImportUsage]
            if code is not None:
                self._unfold(camera, code)
            self.grads.add()

        return shown, backward

    def _route(self, view: AnchorView) -> RoutingArrays:
        """Return the routing. Where nothing trains it, it is that of the whole table, made once."""
        nets = self.nets
        learned = any(t is not None and t.requires_grad for t in self.routers)
        if learned or not nets.routed or any(nets.heads[i].kind != LOCAL for i in nets.routed):
            return route(view)
        key = [t._version for t in self.routers if t is not None]
        if self.kept is None or self.kept[0] != key:
            everyone = torch.arange(len(view.xyz), device=view.xyz.device)
            made = route(replace(view, rows=everyone))
            self.kept = key, RoutingArrays(made.stride, by_row=True, keys=made.keys)
        return self.kept[1]

    def _routing_of(self, drawn: DrawnView, step: int) -> Callable[[], dict[str, Routing]]:
        """Return a function that finds the routing of the anchors as the scene's own decode gives
        it. It keeps no gradients alive."""
        nets, view, arrays, heads = self.nets, drawn.view, drawn.routed, self.scene.heads
        routed = {ATTRIBUTES[i]: i for i in nets.routed}

        def find() -> dict[str, Routing]:
            if arrays.gates is not None:
                return {a: Routing(*arrays.part(nets, i, len(view.rows))) for a, i in routed.items()}  # type: ignore[arg-type]
            feature, position = view.columns[0].index_select(0, view.rows), view.xyz.index_select(0, view.rows) / view.extent
            found = {a: heads[a].route(feature, step, position) for a in routed}
            return {a: made[0] for a, made in found.items() if made is not None}

        return find

    def _finish(self, decoded: Decoded, camera: Camera, step: int) -> tuple[Decoded, tuple[list[Tensor], list[Tensor]] | None]:
        """Apply to a decoded view what acts on drawn Gaussians alone. Returns it, and the two ends
        of its graph, or None where there is nothing to apply."""
        if not self.scene.changes_drawn:
            return decoded, None
        assert decoded.raw_opacity is not None
        with torch.enable_grad():
            leaves = {name: getattr(decoded.gaussians, name).detach().requires_grad_() for name in PARTS}
            raw = decoded.raw_opacity.detach().requires_grad_()
            given = replace(decoded, gaussians=replace(decoded.gaussians, **leaves), raw_opacity=raw)
            out = self.scene.finish(given, camera, step, Mode.TRAIN)
        assert out.raw_opacity is not None
        ends = [*(getattr(out.gaussians, name) for name in PARTS), out.raw_opacity]
        made = {name: end.detach() for name, end in zip(PARTS, ends)}
        shown = replace(out, gaussians=replace(out.gaussians, **made), raw_opacity=ends[-1].detach())
        return shown, ([*leaves.values(), raw], ends)

    def _backward(
        self,
        drawn: DrawnView,
        shown: Decoded,
        graph: tuple[list[Tensor], list[Tensor]] | None,
        gradients: GaussianGradients,
        terms: Regularisers,
    ) -> None:
        A, M = len(drawn.view.rows), len(shown.gaussians)
        volume, hinge = terms.volume / max(M, 1), terms.hinge / max(A * self.nets.K, 1)
        given, raw = [gradients.means, gradients.quats, gradients.scales, gradients.opacities, gradients.colors], None
        if graph is not None:
            leaves, ends = graph
            sizes, below = shown.gaussians.scales, shown.raw_opacity
            assert below is not None
            x, y, z = sizes.unbind(1)
            given[2] = given[2] + volume * torch.stack([y * z, x * z, x * y], dim=1)
            up = [*given, torch.where(below < terms.tau, -hinge, 0.0).to(below)]
            found = torch.autograd.grad(ends, leaves, up, allow_unused=True)
            *given, raw = [torch.zeros_like(t) if f is None else f.contiguous() for t, f in zip(leaves, found)]
            volume = hinge = 0.0
        shared = find_load_gradients(drawn.view, drawn.routed, terms.load) if terms.load and self.nets.groups else None
        made = DecodeGradients(*given, raw=raw, volume=volume, hinge=hinge, tau=float(terms.tau), shared_gates=shared)
        decode_backward(drawn, made, self.into, self.flat)

    def _unfold(self, camera: Camera, code: Tensor) -> None:
        """Turn the gradients of the folded first layer of the colour into those of its weights, its
        bias and the codes."""
        assert self.codes is not None
        (d_w1, d_b1), (to_w1, to_b1), D = self.folded, self.unfolded, self.folded[0].shape[2]
        to_w1[:, :, :D] = d_w1
        to_w1[:, :, D:] = d_b1[:, :, None] * code
        to_b1.copy_(d_b1)
        d_code = torch.einsum("eh,ehc->c", d_b1, self.color.w1.detach()[:, :, D:])
        row = self.codes.row.get(camera.id)
        self.d_codes.zero_()
        self.d_codes[slice(None) if row is None else row] = d_code if row is not None else d_code / len(self.d_codes)
