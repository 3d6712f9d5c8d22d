"""Decode of an anchor scene on CUDA with Triton kernels: gather -> direction -> routing -> experts
-> Gaussians.

Forward and backward compute the same function as `DecodingScene.decode_composed`, the reference.
Anchors are sorted by their set of chosen experts. Top-k therefore evaluates k networks per anchor
instead of E, and no tensor [A, k, outputs] is stored. The host waits for the device once, for the
number of Gaussians. The backward pass recomputes the hidden layers. No sum uses atomics: on one
device, the same inputs give the same bits. Symbols as in `types.py`.

`decode` is differentiable by autograd. `draw` and `backward` are its two halves, for a caller that
needs no graph. Arrays of routing and kinds of heads: see `triton_kernels`.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.types import Gaussians, Routing
from scene_experts.native import triton
from scene_experts.scene.anchors import triton_networks as networks
from scene_experts.scene.anchors.mlp import ATTRIBUTES, NOT_ROUTED, HeadWeights, Outside
from scene_experts.scene.anchors.triton_networks import (
    BLOCK,
    BLOCK_BACKWARD,
    DENSE,
    LOCAL,
    NETWORK,
    PLAIN,
    SPARSE,
    AnchorView,
    KernelNetworks,
    count_units,
    pad,
)
from scene_experts.scene.anchors.triton_routing import RoutingArrays, arrange, bits, route, spread, write_router_gradients

BLOCK_SLOTS = 1024  # slots per program of `number`


@dataclass
class DrawnView:
    """The Gaussians of a view, and what `backward` needs."""

    view: AnchorView
    routed: RoutingArrays
    order: Tensor | None
    gaussians: Gaussians
    raw: Tensor  # [A, K]
    dst: Tensor  # [A K]
    cov: Tensor  # [M, 7]


@dataclass
class DecodeGradients:
    """Gradients of the outputs of a decode. `volume`, `hinge` and `tau` stand for gradients of two terms
    of the loss, see `place_backward`."""

    means: Tensor  # [M, 3]
    quats: Tensor  # [M, 4]
    scales: Tensor  # [M, 3]
    opacities: Tensor  # [M]
    colors: Tensor  # [M, 3]
    raw: Tensor | None = None  # [A, K]
    gates: list[Tensor | None] = field(default_factory=lambda: [None] * 3)  # [A, E] by head
    volume: float = 0.0
    hinge: float = 0.0
    tau: float = 0.0
    shared_gates: Tensor | None = None  # [3, EM]: gradients of the gates that are the same for every anchor


def decode(
    rows: Tensor,
    xyz: Tensor,
    feature: Tensor,
    log_scaling: Tensor,
    offsets: Tensor,
    camera_position: Tensor,
    heads: dict[str, HeadWeights],
    with_dist: dict[str, bool],
    extent: float = 1.0,
    outside: Outside = NOT_ROUTED,
) -> tuple[Gaussians, Tensor, dict[str, Routing]]:
    """Decode anchors into Gaussians.

    Differentiable with respect to feature, log_scaling, offsets, the tensors of the heads and the
    weights in `outside`, but not xyz and the camera. All tensors are float32 on one device unless
    noted.

    Args:
        rows: [A] int64, without duplicates and inside the table. This is not checked, because the
            check would wait for the device.
        xyz: Positions [N, 3].
        feature: Features [N, F].
        log_scaling: Logarithms of the scalings [N, 6].
        offsets: Offsets [N, K, 3].
        camera_position: Camera centre [3].
        heads: Tensors of the networks by attribute ("opacity", "cov", "color").
        with_dist: Whether the network of an attribute receives the distance to the camera.
        extent: Routers that receive positions receive xyz / extent.
        outside: Routing and mixture weights ([A, k], or [A, E] while dense) of the heads that are
            `HeadWeights.routed_outside`. The experts are not checked.

    Returns:
        The Gaussians of positive opacity, ordered by (row, slot); the raw opacities [A, K]; the
        routing of the heads with experts.

    Raises:
        ValueError: The shapes do not match, or the kernels do not support a network.
    """
    nets = KernelNetworks(heads, with_dist, feature.shape[1], offsets.shape[1])
    given = (nets, rows.contiguous(), xyz.detach().contiguous(), camera_position.detach().to(xyz).contiguous(), extent)
    weights = [getattr(heads[a], name) for a in ATTRIBUTES for name in NETWORK]
    routers = [getattr(heads[a], name) for a in ATTRIBUTES for name in ("router_w", "router_b")]
    mixed, keys = zip(*(spread(outside[a], len(heads[a].w1)) if a in outside else (None, None) for a in ATTRIBUTES))
    means, quats, scales, opacities, colors, source, raw, *routing = _Decode.apply(
        given, keys, feature, log_scaling, offsets, *weights, *routers, *mixed
    )
    found = {
        a: outside[a][0] if a in outside else Routing(routing[i], routing[3 + i])
        for i, a in enumerate(ATTRIBUTES)
        if a in outside or routing[i] is not None
    }
    return Gaussians(means, quats, scales, opacities, colors, source), raw, found


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, given: tuple, keys: Any, feature: Tensor, log_scaling: Tensor, offsets: Tensor, *weights: Tensor | None) -> tuple:
        nets, rows, xyz, camera, extent = given
        columns = [t.detach().contiguous() for t in (feature, log_scaling, offsets)]
        plain = [None if t is None else t.detach().contiguous() for t in weights]
        view = AnchorView(nets, rows, xyz, camera, columns, plain[:12], plain[12:18], extent)  # type: ignore[arg-type]
        drawn = draw(view, route(view, plain[18:], keys))
        parts = [drawn.routed.part(nets, i, len(rows)) for i in range(3)]
        gates, chosen = zip(*parts)
        g = drawn.gaussians
        ctx.drawn = drawn
        ctx.mark_non_differentiable(g.source, *(c for c in chosen if c is not None))
        return g.means, g.quats, g.scales, g.opacities, g.colors, g.source, drawn.raw, *gates, *chosen

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *upstream: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        drawn: DrawnView | None = ctx.drawn
        if drawn is None:
            raise RuntimeError("expected one backward pass of a decoded view, found a second: its memory is free; decode the view again")
        ctx.drawn = None
        nets, columns = drawn.view.nets, drawn.view.columns
        means, quats, scales, opacities, colors, _, raw = (g.contiguous() for g in upstream[:7])
        gates = [None if g is None else g.contiguous() for g in upstream[7:10]]
        into = [torch.zeros_like(t) for t in columns]
        flat = columns[0].new_zeros(nets.width)
        mixed = backward(drawn, DecodeGradients(means, quats, scales, opacities, colors, raw, gates), into, flat)
        found = iter(nets.split(flat))
        own = [next(found) for _ in range(12)]
        routers = [next(found) if h.router and (n == 0 or h.bias) else None for h in nets.heads for n in range(2)]
        wanted = ctx.needs_input_grad[2:]
        return None, None, *(g if want else None for g, want in zip([*into, *own, *routers, *mixed], wanted))


def draw(view: AnchorView, routed: RoutingArrays) -> DrawnView:
    """Decode routed anchors."""
    nets, rows, A = view.nets, view.rows, view.rows.shape[0]
    feature, log_scaling, offsets = view.columns
    K = nets.K
    new = feature.new_empty
    order = arrange(view, routed)
    raw, grid = new(A, K), (-(-A // BLOCK),)
    dst = rows.new_empty(A * K, dtype=torch.int32)
    weight, keys = (rows if t is None else t for t in (routed.weight, routed.keys))
    given = (rows, rows if order is None else order, keys, weight, view.xyz, feature, view.camera)
    M = 0
    if A:
        positive = rows.new_empty(A * K, dtype=torch.int32)
        nets.launch("opacity_forward", BY_ROW=routed.by_row)(grid, *given, *view.weights[:4], raw, positive, A)
        counted = positive.cumsum(0, dtype=torch.int32)
        _place_launch("number", B=BLOCK_SLOTS)((-(-A * K // BLOCK_SLOTS),), raw, counted, dst, A * K)
        M = int(counted[-1])  # the host waits for the device only here
    cov, colors = new(M, 7), new(M, 3)
    means, quats, scales, opacities, source = new(M, 3), new(M, 4), new(M, 3), new(M), rows.new_empty(M)
    if M:
        arguments = (*given, *view.weights[4:], dst, cov, colors, A, routed.stride)
        nets.launch("shape_and_color_forward", BY_ROW=routed.by_row)((*grid, 2), *arguments)
        placed = (rows, view.xyz, offsets, log_scaling, raw, cov, dst, means, quats, scales, opacities, source, A)
        _place_launch("place", K=K, B=BLOCK, KP=pad(K, 1))(grid, *placed)
    return DrawnView(view, routed, order, Gaussians(means, quats, scales, opacities, colors, source), raw, dst, cov)


def backward(drawn: DrawnView, gradients: DecodeGradients, into: Sequence[Tensor], flat: Tensor) -> list[Tensor | None]:
    """Write the gradients of the inputs of a view from those of its outputs.

    Args:
        drawn: The view. Only the routing of LOCAL heads may be that of the rows of the table.
        gradients: Those of the outputs, contiguous.
        into: Zeros of the shapes of feature, log-scaling and offsets, for their gradients.
        flat: [width], for the gradients of the networks and routers, see `KernelNetworks.shapes`.

    Returns:
        The gradients of given mixture weights [A, E] by head; None where they were not given.
    """
    view, routed, order, dst = drawn.view, drawn.routed, drawn.order, drawn.dst
    nets, rows, A = view.nets, view.rows, view.rows.shape[0]
    feature, log_scaling, offsets = view.columns
    if not A:
        flat.zero_()
        return [feature.new_zeros(0, h.E) if h.outside else None for h in nets.heads]
    d_cov, d_all = torch.empty_like(drawn.cov), torch.empty_like(drawn.raw)
    terms = bool(gradients.volume or gradients.hinge)
    given = (rows, offsets, log_scaling, drawn.raw, drawn.cov, dst, drawn.gaussians.scales, drawn.gaussians.quats)
    by = (gradients.means, gradients.quats, gradients.scales, gradients.opacities, rows if gradients.raw is None else gradients.raw)
    to = (into[2], into[1], d_cov, d_all, A, gradients.volume, gradients.hinge, gradients.tau)
    back = _place_launch("place_backward", RAW=gradients.raw is not None, TERMS=terms, K=nets.K, B=BLOCK, KP=pad(nets.K, 1))
    grid, blocks = (-(-A // BLOCK),), -(-A // networks.BLOCK_WEIGHTS)
    back(grid, *given, *by, *to)
    d_logits = _push_features(drawn, gradients, d_all, d_cov, into[0])
    P = _parts(feature.device, nets.EM, blocks)
    parts = feature.new_empty(P, nets.width)
    weight, keys = (rows if t is None else t for t in (routed.weight, routed.keys))
    inputs = (rows, rows if order is None else order, keys, weight, view.xyz, feature, view.camera, *view.weights)
    arguments = (*inputs, dst, d_all, d_cov, gradients.colors, parts, A, routed.stride, blocks)
    nets.launch("heads_weights", BY_ROW=routed.by_row)((nets.EM, P, 3), *arguments)
    if d_logits is not None:
        write_router_gradients(view, routed, d_logits, parts)
    elif nets.groups:
        parts[:, nets.places[3] :] = 0.0
    torch.sum(parts, 0, out=flat)
    if d_logits is None:
        return [None] * 3
    far = routed.stride * nets.EM
    return [d_logits[i * far : i * far + A * h.E].view(A, h.E) if h.outside else None for i, h in enumerate(nets.heads)]


def _push_features(drawn: DrawnView, gradients: DecodeGradients, d_all: Tensor, d_cov: Tensor, d_feature: Tensor) -> Tensor | None:
    """Write the gradients of the features. Return those of the logits of all heads, or None if there
    are none."""
    view, routed, order = drawn.view, drawn.routed, drawn.order
    nets, rows, A, stride = view.nets, view.rows, view.rows.shape[0], routed.stride
    with_logits = any(h.kind in (DENSE, SPARSE) for h in nets.heads)
    d_logits = d_all.new_empty(3 * stride * nets.EM) if with_logits else None
    given = [0 if gradients.shared_gates is None and g is None else 1 for g in gradients.gates]
    mode = 2 if gradients.shared_gates is not None else int(any(given))
    d_gates: list[Tensor] = [rows] * 3
    if mode == 2:
        assert gradients.shared_gates is not None
        d_gates = [gradients.shared_gates] * 3
    elif mode == 1:
        zeros = None
        for i, (h, g) in enumerate(zip(nets.heads, gradients.gates)):
            if g is None and h.router:
                g = zeros = d_all.new_zeros(A * nets.EM) if zeros is None else zeros
            d_gates[i] = rows if g is None else g
    arrays = (rows if t is None else t for t in (routed.keys, routed.weight, routed.gates))
    routers = [rows if t is None else t for t in view.routers[0::2]]
    inputs = (*arrays, view.xyz, view.columns[0], view.camera, *routers, *view.weights, drawn.dst, d_all, d_cov, gradients.colors)
    outputs = (*d_gates, rows if d_logits is None else d_logits, d_feature, A, stride)
    passes = [7] if nets.one_order else [1, 2, 4]
    for heads in passes:
        own, ordered = rows, False
        if order is not None and any(heads >> i & 1 for i in nets.ordered):
            own, ordered = order if nets.one_order else order[bits(heads)[0] * stride :], True
        sizes = {"HEADS": heads, "ORDERED": ordered, "BY_ROW": routed.by_row, "ADD": heads in (2, 4), "WITH_GATES": mode}
        nets.launch("heads_backward", **sizes)((-(-A // BLOCK_BACKWARD),), rows, own, *inputs, *outputs)
    return d_logits


def _parts(device: torch.device, experts: int, blocks: int) -> int:
    """Number of programs that share the weight gradients of one expert. It depends only on the device,
    the experts and the blocks."""
    return max(1, min(blocks, 2 * count_units(device) // experts))


class Routes:
    """The routing of all anchors, which does not depend on the camera, and the decode with it.
    Without gradients."""

    @torch.no_grad()
    def __init__(
        self,
        xyz: Tensor,
        columns: list[Tensor],
        heads: dict[str, HeadWeights],
        with_dist: dict[str, bool],
        extent: float,
        outside: Outside = NOT_ROUTED,
    ) -> None:
        """xyz [N, 3]; columns: feature [N, F], log_scaling [N, 6], offsets [N, K, 3], all
        contiguous. Other arguments: see `decode`."""
        self.nets = KernelNetworks(heads, with_dist, columns[0].shape[1], columns[2].shape[1], constant=True)
        self.xyz, self.columns, self.extent = xyz, columns, extent
        mixed, keys = zip(*(spread(outside[a], len(heads[a].w1)) if a in outside else (None, None) for a in ATTRIBUTES))
        everyone = torch.arange(len(xyz), device=xyz.device)
        self.routed = route(self._view(everyone, xyz.new_zeros(3), heads), mixed, keys)
        self.routed.by_row, self.routed.counts, self.routed.chosen = True, None, None
        self.routed.gates = None  # while dense, they are the weights
        if all(h.kind == LOCAL for h in self.nets.heads if h.kind != PLAIN):
            self.routed.weight = None

    @property
    def bytes(self) -> int:
        return sum(t.numel() * t.element_size() for t in (self.routed.weight, self.routed.keys) if t is not None)

    def _view(self, rows: Tensor, camera: Tensor, heads: dict[str, HeadWeights]) -> AnchorView:
        weights = [getattr(heads[a], name).contiguous() for a in ATTRIBUTES for name in NETWORK]
        routers = [getattr(heads[a], name) for a in ATTRIBUTES for name in ("router_w", "router_b")]
        return AnchorView(self.nets, rows.contiguous(), self.xyz, camera, self.columns, weights, routers, self.extent)

    @torch.no_grad()
    def decode(self, rows: Tensor, camera_position: Tensor, heads: dict[str, HeadWeights]) -> tuple[Gaussians, Tensor]:
        """Decode anchors into the Gaussians and raw opacities [A, K] of `decode`, the same bits.
        heads: contiguous tensors."""
        made = draw(self._view(rows, camera_position.to(self.xyz).contiguous(), heads), self.routed)
        return made.gaussians, made.raw


@cache
def _place_launch(name: str, **sizes: Any) -> triton.Launch:
    return triton.Launch(getattr(_places(), name), **sizes)


@cache
def _places() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_places")
