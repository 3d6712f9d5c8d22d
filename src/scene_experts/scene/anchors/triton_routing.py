"""Routing of anchors with Triton kernels: gates, chosen experts, and the order of the anchors by
their set of experts."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType

import torch
from torch import Tensor

from scene_experts.core.types import Routing
from scene_experts.native import triton
from scene_experts.scene.anchors import triton_networks as networks
from scene_experts.scene.anchors.triton_networks import BLOCK, AnchorView, KernelNetworks, count_units, pad

BLOCK_ROUTES = 64  # anchors per program of the routing
MOST_BINS = 64  # keys that the anchors are sorted by counting; more are sorted by torch


@dataclass
class RoutingArrays:
    """Arrays of routing, those of head h from h * stride on. They belong to the anchors of a view,
    or to all rows of a table (`by_row`)."""

    stride: int = 0
    by_row: bool = False
    gates: Tensor | None = None
    weight: Tensor | None = None
    chosen: Tensor | None = None
    keys: Tensor | None = None
    counts: Tensor | None = None

    def part(self, nets: KernelNetworks, i: int, A: int) -> tuple[Tensor | None, Tensor | None]:
        """Return the gates [A, E] and the chosen experts [A, k] of head i, as `Routing` has them."""
        h = nets.heads[i]
        if not h.router or self.gates is None:
            return None, None
        at = i * self.stride
        gates = self.gates[at * nets.EM : at * nets.EM + A * h.E].view(A, h.E)
        if not h.k or self.chosen is None:
            return gates, None
        return gates, self.chosen[at * h.k : at * h.k + A * h.k].view(A, h.k)


def route(view: AnchorView, mixed: Sequence[Tensor | None] = (None,) * 3, keys: Sequence[Tensor | None] = (None,) * 3) -> RoutingArrays:
    """Return the routing of the anchors of a view.

    mixed, keys: for heads that are routed outside, the weights [A, E] and the sets of chosen
    experts [A] int32, as `spread` returns them.
    """
    nets, A = view.nets, view.rows.shape[0]
    if not nets.routed:
        return RoutingArrays()
    stride, EM = _align(A), nets.EM
    new = lambda n, dtype=torch.float32: torch.empty(3 * stride * n, dtype=dtype, device=view.rows.device)  # noqa: E731
    most = max(h.k for h in nets.heads)
    out = RoutingArrays(stride, gates=new(EM), chosen=new(most, torch.int64) if most else None, keys=new(1, torch.int32) if most else None)
    out.weight = new(EM) if most else out.gates
    blocks = -(-A // BLOCK_ROUTES)
    if not A:
        return out
    if most and nets.bins <= MOST_BINS and len(nets.groups) == 1 and not any(h.outside for h in nets.heads):
        out.counts = torch.empty(3, nets.bins, blocks, dtype=torch.int32, device=view.rows.device)
    for (E, k, bias, position), heads in nets.groups.items():
        w, b = view.routers[0::2], view.routers[1::2]
        tensors = [view.rows, view.xyz, view.columns[0], *_filled(w), *_filled(b if bias else w)]
        tensors += [out.gates, out.weight, view.rows if out.chosen is None else out.chosen, view.rows if out.keys is None else out.keys]
        sizes = {"F": nets.F, "E": E, "EM": EM, "TOP": k, "HEADS": heads, "BIAS": bias, "POSITION": position, "B": BLOCK_ROUTES}
        sizes |= {"BINS": 0 if out.counts is None else nets.bins, "FP": pad(nets.F), "EP": pad(E), "PRECISION": networks.PRECISION}
        tensors.append(view.rows if out.counts is None else out.counts)
        triton.launch(_routes().route, (blocks, 3), *tensors, A, stride, blocks, view.extent, **sizes)
        if not k and out.weight is not out.gates:
            for i in bits(heads):
                own = slice(i * stride * EM, (i + 1) * stride * EM)
                out.weight[own] = out.gates[own]  # type: ignore[index]
    for i, (w, key) in enumerate(zip(mixed, keys)):
        if w is not None and out.weight is not None:
            out.weight[i * stride * EM :][: w.numel()] = w.view(-1)
        if key is not None and out.keys is not None:
            out.keys[i * stride :][:A] = key
    return out


def _filled(tensors: Sequence[Tensor | None]) -> list[Tensor]:
    """Return the tensors, with the first that is there in the place of those that are not."""
    there = next(t for t in tensors if t is not None)
    return [there if t is None else t for t in tensors]


def bits(heads: int) -> list[int]:
    return [i for i in range(3) if heads >> i & 1]


def _align(count: int) -> int:
    """Return the distance of the arrays of two heads: Triton compiles anew for addresses that 16
    does not divide."""
    return max(-(-count // 16) * 16, 16)


def arrange(view: AnchorView, routed: RoutingArrays) -> Tensor | None:
    """Return the indices of the anchors sorted by their keys, [A] or [3, stride]; None where no
    head needs them."""
    nets, A = view.nets, view.rows.shape[0]
    if not nets.sorted or not A or routed.keys is None:
        return None
    blocks, stride = -(-A // BLOCK_ROUTES), routed.stride
    order = torch.empty(stride if nets.one_order else 3 * stride, dtype=torch.int32, device=view.rows.device)
    if nets.bins > MOST_BINS:
        for i in nets.sorted:
            keys = routed.keys[i * routed.stride :]
            own = keys.index_select(0, view.rows) if routed.by_row else keys[:A]
            order[(0 if nets.one_order else i) * stride :][:A] = own.argsort(stable=True)
        return order
    sizes = {"HEADS": sum(1 << i for i in nets.sorted), "BY_ROW": routed.by_row, "BINS": nets.bins, "B": BLOCK_ROUTES}
    counts = routed.counts
    if counts is None:
        counts = torch.empty(3, nets.bins, blocks, dtype=torch.int32, device=view.rows.device)
        triton.launch(_routes().count_keys, (blocks, 3), view.rows, routed.keys, counts, A, routed.stride, blocks, **sizes)
    counted = counts.view(3, -1).cumsum(1, dtype=torch.int32)
    to = 0 if nets.one_order else stride
    triton.launch(_routes().arrange, (blocks, 3), view.rows, routed.keys, counted, order, A, routed.stride, to, blocks, **sizes)
    return order


def spread(outside: tuple[Routing, Tensor], E: int) -> tuple[Tensor, Tensor | None]:
    """Return the weights of all experts [A, E], 0 for those that are not chosen, and the set of
    chosen experts as bits [A] int32."""
    chosen, w = outside[0].chosen, outside[1]
    if chosen is None:
        return w.contiguous(), None
    return w.new_zeros(len(w), E).scatter(1, chosen, w), (1 << chosen).sum(1).to(torch.int32)


def find_load_gradients(view: AnchorView, routed: RoutingArrays, weight: float) -> Tensor:
    """Return the gradients [3, EM] of the load-balancing loss, times `weight`, in the gates of every
    anchor. They are those of eq. 7 while a head is dense, and of eq. 6 after it."""
    nets, A = view.nets, len(view.rows)
    blocks = -(-A // BLOCK_ROUTES)
    P = max(1, min(blocks, count_units(view.rows.device)))
    parts = torch.empty(P, 3, nets.EM, device=view.rows.device)
    for (E, k, _, _), heads in nets.groups.items():
        given = (routed.gates, view.rows if routed.keys is None else routed.keys, parts, A, routed.stride, blocks)
        factor = weight * E * (1.0 if k else 2.0) / max(A, 1) ** 2
        sizes = {"E": E, "EM": nets.EM, "HEADS": heads, "SPARSE": bool(k), "B": BLOCK_ROUTES, "EP": pad(E)}
        triton.launch(_routes().load_gradients, (P, 3), *given, factor, **sizes)
    return parts.sum(0)


def write_router_gradients(view: AnchorView, routed: RoutingArrays, d_logits: Tensor, parts: Tensor) -> None:
    """Write the gradients of the routers into parts [P, width], whose sum they are, from those of
    the logits of all heads."""
    nets, A, P = view.nets, len(view.rows), len(parts)
    for (E, _, bias, position), heads in nets.groups.items():
        sizes = {f"AT{i}": nets.places[3 + i] for i in range(3)} | {"WIDTH": nets.width, "HEADS": heads, "BIAS": bias}
        sizes |= {"POSITION": position, "F": nets.F, "E": E, "EM": nets.EM, "B": BLOCK, "EP": pad(E), "RP": pad(nets.F + 4)}
        given = (view.rows, view.xyz, view.columns[0], d_logits, parts, A, routed.stride, -(-A // BLOCK), view.extent)
        triton.launch(_routes().router_weights, (P, 3), *given, **sizes, PRECISION=networks.PRECISION)


@cache
def _routes() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_routes")
