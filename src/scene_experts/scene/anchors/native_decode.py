"""Decode of an anchor scene in the compiled CPU library: gather -> direction -> routing -> experts
-> Gaussians.

Forward and backward compute the same function as `DecodingScene.decode_composed`, the reference. The
anchors of each expert are gathered, so Top-k evaluates k networks per anchor instead of E. The
backward pass recomputes the hidden layers. Gradients are the same bits for every number of threads.
Symbols as in `types.py`. A head has D inputs, H hidden units and L middle layers.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.types import Gaussians, Routing
from scene_experts.native import api
from scene_experts.native import library as native
from scene_experts.native.api import SeDecode
from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, NOT_ROUTED, HeadWeights, Outside
from scene_experts.scene.anchors.quantise import RowRounding

WHAT = "the decode"
TENSORS = api.HEAD_TENSORS
T = len(TENSORS)


@dataclass(frozen=True)
class Plan:
    """Inputs that are not differentiated."""

    rows: Tensor  # [A] int64
    xyz: Tensor  # [N, 3]
    camera: Tensor  # [3]
    k: tuple[int, int, int]  # 0: dense
    distance: tuple[int, int, int]
    position: tuple[int, int, int]  # whether the router receives the position
    extent: float
    ascending: bool
    outside: tuple[bool, bool, bool] = (False, False, False)  # whether the mixture weights are given
    chosen: tuple[Tensor | None, ...] = (None, None, None)  # [A, k] int64, the experts of heads that are routed outside
    factors: Tensor | None = None  # [N], of the steps; None: values are not rounded
    slots: Tensor | None = None  # [N, K] bool: those that are drawn; None: all
    origin: float = 0.0  # where the multiples of log-scalings begin


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
    rounding: RowRounding | None = None,
) -> tuple[Gaussians, Tensor, dict[str, Routing]]:
    """Decode anchors into Gaussians.

    Differentiable with respect to feature, log_scaling, offsets, the tensors of the heads, the
    weights in `outside` and the steps, but not xyz and the camera. All tensors are float32 on the
    CPU unless noted.

    Args:
        rows: [A] int64, without duplicates.
        xyz: Positions [N, 3].
        feature: Features [N, F].
        log_scaling: Logarithms of the scalings [N, 6].
        offsets: Offsets [N, K, 3].
        camera_position: Camera centre [3].
        heads: Tensors of the networks by attribute ("opacity", "cov", "color").
        with_dist: Whether the network of an attribute receives the distance to the camera.
        extent: Routers that receive positions receive xyz / extent.
        outside: Routing and mixture weights ([A, k], or [A, E] while dense) of the heads that are
            `HeadWeights.routed_outside`.
        rounding: How the values of all rows are rounded, and which slots are drawn; None: values
            are drawn as they are. `RowRounding.mark` gives the masks their gradients.

    Returns:
        The Gaussians of positive opacity, ordered by (row, slot); the raw opacities [A, K]; the
        routing of the heads with experts.

    Raises:
        ValueError: The shapes do not match.
        IndexError: A row is outside the table, or a chosen expert does not exist.
    """
    found = [heads[a] for a in ATTRIBUTES]
    distance = tuple(int(with_dist[a]) for a in ATTRIBUTES)
    _check(xyz, feature, log_scaling, offsets, found, distance)
    check_outside(heads, outside, len(rows))
    rows = rows.contiguous()
    ascending = len(rows) > 0 and bool((rows[1:] > rows[:-1]).all())
    if len(rows):
        low, high = (int(rows[0]), int(rows[-1])) if ascending else (int(rows.min()), int(rows.max()))
        if low < 0 or high >= len(xyz):
            raise IndexError(f"expected rows from 0 to {len(xyz) - 1}, found {low} to {high}")
    plan = make_plan(rows, xyz, camera_position, heads, with_dist, extent, ascending)
    chosen = tuple(outside[a][0].chosen if a in outside else None for a in ATTRIBUTES)
    plan = replace(
        plan, outside=tuple(a in outside for a in ATTRIBUTES), chosen=tuple(None if c is None else c.contiguous() for c in chosen)
    )
    log_steps = None
    if rounding is not None:
        log_steps = rounding.log_steps
        plan = replace(plan, factors=rounding.factors.contiguous(), slots=rounding.open.contiguous(), origin=rounding.origins[1])
    weights = [getattr(h, name) for h in found for name in TENSORS]
    mixed = [outside[a][1] if a in outside else None for a in ATTRIBUTES]
    out = _DecodeFunction.apply(plan, feature, log_scaling, offsets, *weights, *mixed, log_steps)
    means, quats, scales, opacities, colors, source, raw = out[:7]
    found_routing = {a: Routing(gates, picked) for a, gates, picked in zip(ATTRIBUTES, out[7:10], out[10:13]) if gates is not None}
    routing = {a: outside[a][0] if a in outside else found_routing[a] for a in ATTRIBUTES if a in outside or a in found_routing}
    return Gaussians(means, quats, scales, opacities, colors, source), raw, routing


def check_outside(heads: Mapping[str, HeadWeights], outside: Outside, A: int) -> None:
    """Raise ValueError unless `outside` has weights of the right shape for each head that is routed
    outside, IndexError for experts that do not exist."""
    for a, h in heads.items():
        if h.routed_outside != (a in outside):
            raise ValueError(f"expected mixture weights for the heads that are routed outside, found other ones for {a}")
        if a in outside:
            (routing, weight), E = outside[a], len(h.w1)
            if tuple(weight.shape) != (A, h.k or E) or (routing.chosen is None) != (h.k is None):
                raise ValueError(f"expected mixture weights [{A}, {h.k or E}] for {a}, found {tuple(weight.shape)}")
            if routing.chosen is not None and A and not 0 <= int(routing.chosen.min()) <= int(routing.chosen.max()) < E:
                raise IndexError(f"expected experts from 0 to {E - 1} for {a}, found others")


def make_plan(
    rows: Tensor, xyz: Tensor, camera: Tensor, heads: dict[str, HeadWeights], with_dist: dict[str, bool], extent: float, ascending: bool
) -> Plan:
    """Collect the inputs that are not differentiated. The arguments are those of `decode`;
    ascending: whether `rows` are sorted."""
    found = [heads[a] for a in ATTRIBUTES]
    k = tuple(h.k or 0 for h in found)
    distance = tuple(int(with_dist[a]) for a in ATTRIBUTES)
    position = tuple(int(h.position) for h in found)
    camera = camera.detach().to(torch.float32).contiguous()
    return Plan(rows.contiguous(), xyz.detach().contiguous(), camera, k, distance, position, extent, ascending)  # type: ignore[arg-type]


def _check(xyz: Tensor, feature: Tensor, log_scaling: Tensor, offsets: Tensor, heads: list[HeadWeights], distance: tuple[int, ...]) -> None:
    N, F, K = len(xyz), feature.shape[1], offsets.shape[1]
    wanted = [("xyz", xyz, (N, 3)), ("feature", feature, (N, F)), ("log_scaling", log_scaling, (N, 6)), ("offsets", offsets, (N, K, 3))]
    for a, h, extra in zip(ATTRIBUTES, heads, distance):
        E, H, out = h.w1.shape[0], h.w1.shape[1], K * CHANNELS[a]
        wanted += [(f"{a}.w1", h.w1, (E, H, F + 3 + extra)), (f"{a}.b1", h.b1, (E, H))]
        wanted += [(f"{a}.w2", h.w2, (E, out, H)), (f"{a}.b2", h.b2, (E, out))]
        if h.middle_w is not None and h.middle_b is not None:
            L = h.middle_w.shape[1]
            wanted += [(f"{a}.middle_w", h.middle_w, (E, L, H, H)), (f"{a}.middle_b", h.middle_b, (E, L, H))]
        if h.k is not None and not 1 <= h.k <= E:
            raise ValueError(f"expected k between 1 and {E} for {a}, found {h.k}")
        if h.router_w is not None:
            wanted += [(f"{a}.router_w", h.router_w, (E, F + 3 * h.position))]
            wanted += [] if h.router_b is None else [(f"{a}.router_b", h.router_b, (E,))]
    for name, tensor, shape in wanted:
        if tuple(tensor.shape) != shape or tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise ValueError(
                f"expected {name} of shape {shape}, float32 on the CPU, found {tuple(tensor.shape)} {tensor.dtype} {tensor.device}"
            )


def route(call: SeDecode) -> None:
    """Compute only the gates, chosen experts and weights, into the tensors given to
    `set_routing`."""
    native.check(native.require().se_decode_route(ctypes.byref(call)), WHAT)


def run(call: SeDecode) -> tuple[tuple[Tensor, ...], Tensor, Tensor, Tensor]:
    """Decode with the inputs of `make_call` and the outputs of `set_routing`.

    Returns the fields of `Gaussians` and the raw opacities [A, K]; for the backward pass, the first
    Gaussian of each chunk and the inverse lengths [M] of the quaternions before normalisation.
    """
    library = native.require()
    raw, starts = torch.empty(call.A, call.K), torch.zeros(library.se_decode_chunks(call.A) + 1, dtype=torch.int64)
    set_pointers(call, raw=raw, starts=starts)
    native.check(library.se_decode_begin(ctypes.byref(call)), WHAT)
    M = int(starts[-1])
    means, quats, scales, colors = torch.empty(M, 3), torch.empty(M, 4), torch.empty(M, 3), torch.empty(M, 3)
    opacities, per_length, source = torch.empty(M), torch.empty(M), torch.empty(M, dtype=torch.int64)
    set_pointers(call, means=means, quats=quats, scales=scales, opacities=opacities, colors=colors, per_length=per_length, source=source)
    native.check(library.se_decode_emit(ctypes.byref(call)), WHAT)
    return (means, quats, scales, opacities, colors, source), raw, starts, per_length


class _DecodeFunction(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, plan: Plan, feature: Tensor, log_scaling: Tensor, offsets: Tensor, *weights: Tensor | None) -> tuple:
        columns = [t.detach().contiguous() for t in (feature, log_scaling, offsets)]
        weights = tuple(None if t is None else t.detach().contiguous() for t in weights)
        weights, given, log_steps = weights[: 3 * T], weights[3 * T : -1], weights[-1]
        A, steps = len(plan.rows), None if log_steps is None else log_steps.exp()
        call = make_call(plan, columns, weights, steps)
        gates, chosen, chosen_weight = [], [], []
        for i, k in enumerate(plan.k):
            routed, E = weights[T * i] is not None, call.heads[i].E
            gates.append(torch.empty(A, E) if routed else None if k else given[i])
            chosen.append(torch.empty(A, k, dtype=torch.int64) if routed and k else plan.chosen[i])
            chosen_weight.append(torch.empty(A, k) if routed and k else given[i] if k else None)
        set_routing(call, gates, chosen, chosen_weight)
        (means, quats, scales, opacities, colors, source), raw, starts, per_length = run(call)
        made = (means, quats, scales, opacities, colors)
        ctx.plan = plan
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(*columns, *weights, raw, starts, *made, per_length, *gates, *chosen, *chosen_weight, steps)
        shown = [[None if out else t for out, t in zip(plan.outside, found)] for found in (gates, chosen)]
        ctx.mark_non_differentiable(source, *(c for c in shown[1] if c is not None))
        return means, quats, scales, opacities, colors, source, raw, *shown[0], *shown[1]

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor | None) -> tuple:
        plan: Plan = ctx.plan
        saved = ctx.saved_tensors
        columns, weights, made, routing = saved[:3], saved[3 : 3 + 3 * T], saved[3 + 3 * T : 11 + 3 * T], saved[11 + 3 * T : -1]
        steps = saved[-1]
        raw, starts, means, quats, scales, opacities, colors, per_length = made
        call = make_call(plan, columns, weights, steps)
        set_pointers(
            call, raw=raw, starts=starts, means=means, quats=quats, scales=scales, opacities=opacities, colors=colors, per_length=per_length
        )
        set_routing(call, routing[:3], routing[3:6], routing[6:])
        given = [None if g is None else g.contiguous() for g in upstream]
        set_pointers(call, d_means=given[0], d_quats=given[1], d_scales=given[2], d_opacities=given[3], d_colors=given[4], d_raw=given[6])
        # If the rows are sorted, the library writes every row of the gradients, with zeros for rows
        # that are not decoded.
        fresh = torch.empty_like if plan.ascending else torch.zeros_like
        d_columns, d_weights = [fresh(t) for t in columns], [None if t is None else torch.empty_like(t) for t in weights]
        d_log_steps = None if steps is None else torch.empty_like(steps)
        set_pointers(call, d_feature=d_columns[0], d_log_scaling=d_columns[1], d_offsets=d_columns[2], d_log_steps=d_log_steps)
        for i, head in enumerate(call.heads):
            set_pointers(head, d_gates=given[7 + i], **{f"d_{name}": d_weights[T * i + j] for j, name in enumerate(TENSORS)})
        mixed = [raw.new_empty(len(raw), h.k or h.E) if out else None for out, h in zip(plan.outside, call.heads)]
        for head, d_weight in zip(call.heads, mixed):
            set_pointers(head, d_weight=d_weight)
        native.check(native.require().se_decode_backward(ctypes.byref(call)), "the backward pass of the decode")
        wanted = ctx.needs_input_grad[1:]
        return None, *(g if want else None for g, want in zip([*d_columns, *d_weights, *mixed, d_log_steps], wanted))


def make_call(plan: Plan, columns: Any, weights: Any, steps: Tensor | None = None) -> SeDecode:
    """Return the structure with all inputs. The tensors must outlive the call. steps: [F + 6 + 3 K],
    with `plan.factors`."""
    feature, log_scaling, offsets = columns
    call = SeDecode(
        A=len(plan.rows), N=len(plan.xyz), K=offsets.shape[1], F=feature.shape[1], threads=native.count_threads(), ascending=plan.ascending
    )
    call.extent, call.origin = plan.extent, plan.origin
    set_pointers(call, rows=plan.rows, xyz=plan.xyz, feature=feature, log_scaling=log_scaling, offsets=offsets, camera=plan.camera)
    set_pointers(call, steps=steps, factors=None if steps is None else plan.factors, slots=plan.slots)
    for i, head in enumerate(call.heads):
        own = dict(zip(TENSORS, weights[T * i : T * i + T]))
        set_pointers(head, **own)
        head.E, head.H, head.out = own["w1"].shape[0], own["w1"].shape[1], own["w2"].shape[1]
        head.L = 0 if own["middle_w"] is None else own["middle_w"].shape[1]
        head.k, head.distance, head.position = plan.k[i], plan.distance[i], plan.position[i]
    return call


def set_pointers(structure: ctypes.Structure, **tensors: Tensor | None) -> None:
    for name, tensor in tensors.items():
        setattr(structure, name, native.pointer(tensor))


def set_routing(call: SeDecode, gates: Any, chosen: Any, chosen_weight: Any) -> None:
    for head, g, c, m in zip(call.heads, gates, chosen, chosen_weight):
        set_pointers(head, gates=g, chosen=c, chosen_weight=m)
