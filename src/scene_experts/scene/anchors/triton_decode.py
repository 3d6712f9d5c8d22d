"""Decode of an anchor scene on CUDA with Triton kernels: gather -> direction -> routing -> experts
-> Gaussians.

Forward and backward compute the same function as `AnchorScene.decode_composed`, the reference.
Anchors are sorted by their set of chosen experts. Top-k therefore evaluates k networks per anchor
instead of E, and no tensor [A, k, outputs] is stored. The host waits for the device once, for the
number of Gaussians. The backward pass recomputes the hidden layers. No sum uses atomics: on one
device, the same inputs give the same bits. Symbols as in `types.py`.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.types import Gaussians, Routing
from scene_experts.native import triton
from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, NOT_ROUTED, HeadWeights, Outside

ACTIVATION = {"opacity": 0, "cov": 1, "color": 2}  # TANH, NONE, SIGMOID of triton_kernels.py
TENSORS = ("router_w", "router_b", "w1", "b1", "w2", "b2")
PRECISION = "ieee"  # of matrix products: "ieee" is float32, "tf32x3" is nearly float32 on tensor cores, "tf32" is less precise
BLOCK = 32  # anchors per program; with the paper's sizes, the largest block whose tiles fit in registers
BLOCK_WEIGHTS = 16  # anchors per step of `weight_backward`, which also keeps the gradient of a network in registers
WARPS_BACKWARD = {16: 4, 32: 4, 64: 8}
"""Warps of `head_backward` by padded hidden width. Measured on an H100, as WARPS_WEIGHTS: there 8 is
four times as fast as 4."""
WARPS_WEIGHTS = 8
MOST_EXPERTS = 30  # a set of experts is stored as the bits of an int32
WIDEST = 256  # largest padded number of outputs


def covers(attribute: str, h: HeadWeights, F: int, K: int) -> bool:
    """Whether the kernels support a network (two layers, held in registers) and its number of
    experts."""
    E, H = h.w1.shape[:2]
    fits = pad(F + 5) <= 64 and pad(H) <= 64 and pad(K * CHANNELS[attribute]) <= WIDEST
    return h.middle_w is None and fits and E <= MOST_EXPERTS


def pad(n: int, least: int = 16) -> int:
    """Return the smallest power of two that is at least n and `least`."""
    return max(least, 1 << (n - 1).bit_length())


@dataclass(frozen=True)
class _Head:
    """The kernels' view of one attribute."""

    attribute: str
    E: int
    k: int  # 0: dense, or no router
    routed: bool  # a mixture, whoever computes its weights
    outside: bool  # the mixture weights are given
    distance: bool
    position: bool  # whether the router receives the position
    sizes: dict[str, Any]  # the compile-time constants of its three kernels


@dataclass(frozen=True)
class _Plan:
    """Inputs that are not differentiated."""

    rows: Tensor  # [A] int64
    xyz: Tensor  # [N, 3]
    camera: Tensor  # [3]
    heads: tuple[_Head, _Head, _Head]
    extent: float

    def order(self, keys: Tensor) -> Tensor:
        """Return the indices [A] int64 that sort the anchors by their sets of experts."""
        return keys.argsort(stable=True)


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
    F, K = feature.shape[1], offsets.shape[1]
    made = tuple(_head(a, heads[a], with_dist[a], F, K) for a in ATTRIBUTES)
    plan = _Plan(rows.contiguous(), xyz.detach().contiguous(), camera_position.detach().to(xyz).contiguous(), made, extent)  # type: ignore[arg-type]
    weights = [getattr(heads[a], name) for a in ATTRIBUTES for name in TENSORS]
    mixed, keys = zip(*(_spread(outside[a], len(heads[a].w1)) if a in outside else (None, None) for a in ATTRIBUTES))
    means, quats, scales, opacities, colors, source, raw, *routing = _Decode.apply(
        plan, keys, feature, log_scaling, offsets, *weights, *mixed
    )
    found = {
        a: outside[a][0] if a in outside else Routing(routing[i], routing[3 + i])
        for i, a in enumerate(ATTRIBUTES)
        if a in outside or routing[i] is not None
    }
    return Gaussians(means, quats, scales, opacities, colors, source), raw, found


def _spread(outside: tuple[Routing, Tensor], E: int) -> tuple[Tensor, Tensor | None]:
    """Return the weights of all experts [A, E], 0 for those that are not chosen, and the set of
    chosen experts as bits [A] int32."""
    chosen, w = outside[0].chosen, outside[1]
    if chosen is None:
        return w.contiguous(), None
    return w.new_zeros(len(w), E).scatter(1, chosen, w), (1 << chosen).sum(1).to(torch.int32)


def _head(attribute: str, h: HeadWeights, distance: bool, F: int, K: int) -> _Head:
    E, H, D = h.w1.shape
    C = CHANNELS[attribute]
    if F + 3 + distance != D or tuple(h.w2.shape) != (E, K * C, H):
        expected = f"{attribute} weights [E, H, {F + 3 + distance}] and [E, {K * C}, H]"
        raise ValueError(f"expected {expected}, found {tuple(h.w1.shape)} and {tuple(h.w2.shape)}")
    if h.middle_w is not None:
        raise ValueError(f"expected networks of two layers, found {2 + h.middle_w.shape[1]} for {attribute}")
    routed = E > 1 or h.router_w is not None
    if h.router_w is not None and h.router_w.shape[1] != F + 3 * h.position:
        raise ValueError(f"expected {attribute} router weights [{E}, {F + 3 * h.position}], found {tuple(h.router_w.shape)}")
    if routed and h.k is not None and not 1 <= h.k <= E:
        raise ValueError(f"expected k between 1 and {E} for {attribute}, found {h.k}")
    sizes: dict[str, Any] = {"E": E, "F": F, "H": H, "K": K, "C": C, "DISTANCE": int(distance), "ROUTED": routed}
    sizes |= {"SPARSE": routed and h.k is not None, "ACT": ACTIVATION[attribute], "COMPACT": attribute != "opacity"}
    sizes |= {"XP": pad(D + 1), "HP": pad(H), "COLS": pad(K * C), "PRECISION": PRECISION}
    return _Head(attribute, E, (h.k or 0) if routed else 0, routed, h.routed_outside, distance, h.position, sizes)


def _kernels() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_kernels")


def _parts(device: torch.device, experts: int, blocks: int) -> int:
    """Number of programs that share the weight gradients of one expert. It depends only on the
    device, the experts and the blocks."""
    units = torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 2
    return max(1, min(blocks, 2 * units // experts))


class _Decode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: _Plan, keys: Any, feature: Tensor, log_scaling: Tensor, offsets: Tensor, *weights: Tensor | None) -> tuple:
        columns = [t.detach().contiguous() for t in (feature, log_scaling, offsets)]
        weights = tuple(None if t is None else t.detach().contiguous() for t in weights)
        weights, mixed = weights[:18], weights[18:]
        routes = [
            _given(plan, mixed[i], keys[i]) if head.outside else _route(plan, head, columns[0], weights[6 * i : 6 * i + 6])
            for i, head in enumerate(plan.heads)
        ]
        (means, quats, scales, opacities, colors, source, raw), dst, cov = _draw(plan, columns, weights, routes)
        gates, chosen = [r[0] for r in routes], [r[2] for r in routes]
        ctx.plan = plan
        ctx.mark_non_differentiable(source, *(c for c in chosen if c is not None))
        ctx.save_for_backward(*columns, *weights, dst, cov, quats, *(t for r in routes for t in (r[0], r[1], r[3], r[4])))
        return means, quats, scales, opacities, colors, source, raw, *gates, *chosen

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple:
        plan: _Plan = ctx.plan
        saved = ctx.saved_tensors
        columns, weights, (dst, cov, quats) = saved[:3], saved[3:21], saved[21:24]
        routes = [(*saved[24 + 4 * i : 26 + 4 * i], None, *saved[26 + 4 * i : 28 + 4 * i]) for i in range(3)]
        A, K = len(plan.rows), columns[2].shape[1]
        d_means, d_quats, d_scales, d_opacities, d_colors, _, d_raw = (g.contiguous() for g in upstream[:7])
        d_gates = [None if g is None else g.contiguous() for g in upstream[7:10]]
        d_feature, d_log_scaling, d_offsets = (torch.zeros_like(t) for t in columns)
        d_cov, d_all = torch.empty_like(cov), cov.new_empty(A, K)
        if A:
            given = (plan.rows, columns[2], columns[1], cov, dst, quats, d_means, d_quats, d_scales, d_opacities, d_raw)
            grid = (-(-A // BLOCK),)
            triton.launch(_kernels().place_backward, grid, *given, d_offsets, d_log_scaling, d_cov, d_all, A, K=K, B=BLOCK, KP=pad(K, 1))
        wanted = ctx.needs_input_grad[2:]
        d_weights: list[Tensor | None] = []
        d_mixed: list[Tensor | None] = []
        for i, d_out in enumerate((d_all, d_cov, d_colors)):
            trained = any(wanted[3 + 6 * i : 5 + 6 * i])
            own, mixed = _backward(plan, i, routes[i], columns[0], weights, dst, d_out, d_gates[i], d_feature, trained)
            d_weights, d_mixed = d_weights + own, [*d_mixed, mixed]
        return None, None, *(g if want else None for g, want in zip([d_feature, d_log_scaling, d_offsets, *d_weights, *d_mixed], wanted))


def _draw(plan: _Plan, columns: list[Tensor], weights: Any, routes: Any) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
    """Return the Gaussians and raw opacities [A, K] of routed anchors; the place [A K] of each
    Gaussian, -1: not drawn; shapes [M, 7]."""
    (feature, log_scaling, offsets), A, K = columns, len(plan.rows), columns[2].shape[1]
    raw = feature.new_empty(A, K)
    _forward(plan, 0, routes, feature, weights, raw, raw)
    counted = (raw > 0).view(-1).cumsum(0, dtype=torch.int32)
    M = int(counted[-1]) if A else 0  # the host waits for the device only here
    dst = torch.where(raw.view(-1) > 0, counted - 1, -1)
    cov, colors = feature.new_empty(M, 7), feature.new_empty(M, 3)
    _forward(plan, 1, routes, feature, weights, dst, cov)
    _forward(plan, 2, routes, feature, weights, dst, colors)
    means, quats, scales, opacities = (feature.new_empty(M, *shape) for shape in ((3,), (4,), (3,), ()))
    source = torch.empty(M, dtype=torch.int64, device=raw.device)
    if M:
        arguments = (plan.rows, plan.xyz, offsets, log_scaling, raw, cov, dst, means, quats, scales, opacities, source, A)
        triton.launch(_kernels().place, (-(-A // BLOCK),), *arguments, K=K, B=BLOCK, KP=pad(K, 1))
    return (means, quats, scales, opacities, colors, source, raw), dst, cov


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
        F, K = columns[0].shape[1], columns[2].shape[1]
        self.columns, self.heads = columns, tuple(_head(a, heads[a], with_dist[a], F, K) for a in ATTRIBUTES)
        everyone = torch.arange(len(xyz), device=xyz.device)
        self.plan = _Plan(everyone, xyz, xyz.new_zeros(3), self.heads, extent)  # type: ignore[arg-type]
        given = {a: _spread(found, len(heads[a].w1)) for a, found in outside.items()}
        routes = [
            _given(self.plan, *given[a]) if a in given else _route(self.plan, h, columns[0], [heads[a].router_w, heads[a].router_b])
            for a, h in zip(ATTRIBUTES, self.heads)
        ]
        self.weights, self.keys = _stack([r[1] for r in routes]), _stack([r[3] for r in routes])

    @property
    def bytes(self) -> int:
        return sum(t.numel() * t.element_size() for t in (*self.weights, *self.keys) if t is not None)

    @torch.no_grad()
    def decode(self, rows: Tensor, camera_position: Tensor, heads: dict[str, HeadWeights]) -> tuple[Gaussians, Tensor]:
        """Decode anchors into the Gaussians and raw opacities [A, K] of `decode`, the same bits.
        heads: contiguous tensors."""
        plan = replace(self.plan, rows=rows.contiguous(), camera=camera_position.to(self.plan.xyz).contiguous())
        weights, keys = _gather(self.weights, plan.rows), _gather(self.keys, plan.rows)
        routes = [(None, w, None, k, None if k is None else plan.order(k)) for w, k in zip(weights, keys)]
        made, _, _ = _draw(plan, self.columns, tuple(getattr(heads[a], name) for a in ATTRIBUTES for name in TENSORS), routes)
        return Gaussians(*made[:6]), made[6]


Columns = Tensor | list[Tensor | None]
"""A tensor of N rows for each attribute; those of one shape are one tensor [3, N, ..]."""


def _stack(columns: list[Tensor | None]) -> Columns:
    found = [t for t in columns if t is not None]
    return torch.stack(found) if len(found) == len(columns) and len({t.shape for t in found}) == 1 else columns


def _gather(columns: Columns, rows: Tensor) -> list[Tensor | None]:
    if isinstance(columns, Tensor):
        return list(columns.index_select(1, rows))
    return [None if t is None else t.index_select(0, rows) for t in columns]


def _route(plan: _Plan, head: _Head, feature: Tensor, weights: Any) -> tuple[Tensor | None, ...]:
    """Return gates [A, E], weights [A, E] (the gates while dense), chosen experts [A, k], keys [A],
    order [A]. None: unused."""
    if not head.routed:
        return (None,) * 5
    A, device = len(plan.rows), feature.device
    gates = feature.new_empty(A, head.E)
    weight, chosen, keys = gates, None, None
    if head.k:
        weight, chosen = torch.empty_like(gates), torch.empty(A, head.k, dtype=torch.int64, device=device)
        keys = torch.empty(A, dtype=torch.int32, device=device)
    if A:
        bias = weights[1]
        sizes = {"F": feature.shape[1], "E": head.E, "TOP": head.k, "BIAS": bias is not None, "POSITION": head.position}
        sizes |= {"FP": pad(feature.shape[1]), "EP": pad(head.E), "B": BLOCK, "PRECISION": PRECISION}
        unused = plan.rows  # placeholder for arrays that the kernel does not access
        arguments = [plan.rows, plan.xyz, feature, weights[0], bias, gates, weight, chosen, keys]
        triton.launch(_kernels().route, (-(-A // BLOCK),), *(unused if t is None else t for t in arguments), A, plan.extent, **sizes)
    return gates, weight, chosen, keys, None if keys is None else plan.order(keys)


def _given(plan: _Plan, weight: Tensor | None, keys: Tensor | None) -> tuple[Tensor | None, ...]:
    """Return the same as `_route` for given weights [A, E] and sets of chosen experts [A]: without
    gates and indices."""
    return None, weight, None, keys, None if keys is None else plan.order(keys)


def _forward(plan: _Plan, i: int, routes: Any, feature: Tensor, weights: Any, dst: Tensor, out: Tensor) -> None:
    """Write attribute i to `out`, for all slots (opacity) or for the drawn slots only."""
    A = len(plan.rows)
    if not out.numel():
        return
    _, weight, _, keys, order = routes[i]
    arguments = [plan.rows, order, keys, weight, plan.xyz, feature, plan.camera, *weights[6 * i + 2 : 6 * i + 6], dst, out]
    given = (plan.rows if t is None else t for t in arguments)
    triton.launch(_kernels().head_forward, (-(-A // BLOCK),), *given, A, **plan.heads[i].sizes, B=BLOCK)


def _backward(
    plan: _Plan,
    i: int,
    route: Any,
    feature: Tensor,
    weights: Any,
    dst: Tensor,
    d_out: Tensor,
    d_gates: Tensor | None,
    d_feature: Tensor,
    router: bool,
) -> tuple[list[Tensor | None], Tensor | None]:
    """Return the gradients of the six tensors of attribute i and of given mixture weights, and add
    its part to `d_feature`. `router`: whether those of the router are wanted."""
    head, own, A = plan.heads[i], weights[6 * i : 6 * i + 6], len(plan.rows)
    gates, weight, _, keys, order = route
    if not A:
        return [None if t is None else torch.zeros_like(t) for t in own], torch.zeros_like(weight) if head.outside else None
    d_logits = torch.empty_like(weight) if head.routed else None  # of the given weights, where they are given
    shared = [plan.rows, order, keys, weight]
    arguments = [*shared, gates, plan.xyz, feature, plan.camera, own[0], *own[2:], dst, d_out, d_gates, d_logits, d_feature]
    grid = (-(-A // BLOCK),)
    triton.launch(
        _kernels().head_backward,
        grid,
        *(plan.rows if t is None else t for t in arguments),
        A,
        **head.sizes,
        B=BLOCK,
        EP=pad(head.E),
        POSITION=head.position,
        OUTSIDE=head.outside,
        num_warps=WARPS_BACKWARD[head.sizes["HP"]],
    )
    blocks = -(-A // BLOCK_WEIGHTS)
    parts = [t.new_empty(_parts(t.device, head.E, blocks), *t.shape) for t in own[2:]]
    arguments = [*shared, plan.xyz, feature, plan.camera, *own[2:], dst, d_out, *parts]
    given = (plan.rows if t is None else t for t in arguments)
    triton.launch(
        _kernels().weight_backward, (head.E, len(parts[0])), *given, A, blocks, **head.sizes, B=BLOCK_WEIGHTS, num_warps=WARPS_WEIGHTS
    )
    found: list[Tensor | None] = [None, None]
    if router and d_logits is not None and not head.outside:
        seen = feature.index_select(0, plan.rows)
        if head.position:
            seen = torch.cat([seen, plan.xyz.index_select(0, plan.rows) / plan.extent], dim=1)
        found[0] = d_logits.T @ seen
        found[1] = None if own[1] is None else d_logits.sum(0)
    return [*found, *(part.sum(0) for part in parts)], d_logits if head.outside else None
