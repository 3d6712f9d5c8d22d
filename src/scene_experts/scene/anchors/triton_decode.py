"""Decode of an anchor scene on CUDA with Triton kernels: gather -> direction -> routing -> experts
-> Gaussians.

Forward and backward compute the same function as `AnchorScene.decode_composed`, the reference.
Anchors are sorted by their set of chosen experts. Top-k therefore evaluates k networks per anchor
instead of E, and no tensor [A, k, outputs] is stored. The host waits for the device once, for the
number of Gaussians. The backward pass recomputes the hidden layers. No sum uses atomics: on one
device, the same inputs give the same bits. Symbols as in `types.py`.

`decode` is differentiable by autograd. `draw` and `pull_back` are its two halves, for a caller that
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
from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, NOT_ROUTED, HeadWeights, Outside

NETWORK = ("w1", "b1", "w2", "b2")
TENSORS = ("router_w", "router_b", *NETWORK)
PLAIN, DENSE, SPARSE, LOCAL = 0, 1, 2, 3
PRECISION = "ieee"  # of matrix products: "ieee" is float32, "tf32x3" is nearly float32 on tensor cores, "tf32" is less precise
BLOCK = 32  # anchors per program; with the paper's sizes, the largest block whose tiles fit in registers
BLOCK_WEIGHTS = 16  # anchors per step of `heads_weights`, which also keeps the slopes of a network in registers
BLOCK_ROUTES = 64  # anchors per program of the routing
BLOCK_SLOTS = 1024  # slots per program of `number`
BLOCK_BACKWARD = 16  # anchors per program of `heads_backward`
WARPS_BACKWARD = 8
WARPS_WEIGHTS = {16: 8, 32: 8, 64: 16}
"""Warps of `heads_backward`, and of `heads_weights` by padded hidden width: next to nothing is kept in
local memory (sm_90). For one head, 8 and 16 were four times as fast as 4 on an H100."""
MOST_EXPERTS = 30  # a set of experts is stored as the bits of an int32
MOST_BINS = 64  # keys that the anchors are sorted by counting; more are sorted by torch
WIDEST = 256  # largest padded number of outputs
LARGEST_LAYER = 64 * 128  # padded weights of a last layer: with more, the 99 KiB of shared memory of an RTX 30, 40 or 50 are too few


def covers(attribute: str, h: HeadWeights, F: int, K: int) -> bool:
    """Whether the kernels support a network (two layers, held in registers) and its number of
    experts."""
    E, H = h.w1.shape[:2]
    outputs = pad(K * CHANNELS[attribute])
    fits = pad(F + 5) <= 64 and pad(H) <= 64 and outputs <= WIDEST and pad(H) * outputs <= LARGEST_LAYER
    return h.middle_w is None and fits and E <= MOST_EXPERTS


def pad(n: int, least: int = 16) -> int:
    """Return the smallest power of two that is at least n and `least`."""
    return max(least, 1 << (n - 1).bit_length())


@dataclass(frozen=True)
class KernelHead:
    """The kernels' view of one attribute."""

    E: int
    k: int  # 0: dense, or no router
    kind: int
    outside: bool  # the mixture weights are given
    distance: bool
    position: bool  # whether the router receives the position
    bias: bool
    shapes: tuple[tuple[int, ...], ...]  # of the tensors of `NETWORK`
    router: tuple[tuple[int, ...], ...]  # shapes of weights and bias of the router; empty without one in the kernels

    @property
    def group(self) -> tuple[Any, ...]:
        """Heads of one group are routed by one launch."""
        return self.E, self.k, self.bias, self.position


class KernelNetworks:
    """The networks of a scene as the kernels take them: the compile-time constants, and where the
    slopes of each tensor lie in one array."""

    def __init__(self, heads: dict[str, HeadWeights], with_dist: dict[str, bool], F: int, K: int, constant: bool = False) -> None:
        """constant: the caller has no slopes of gates. Weights of one chosen expert are then 1 and
        have none. Raises ValueError if the shapes do not match, or the kernels do not support a
        network."""
        self.F, self.K, self.H = F, K, heads["opacity"].w1.shape[1]
        self.heads = tuple(_head(a, heads[a], with_dist[a], F, K, constant) for a in ATTRIBUTES)
        if len({h.w1.shape[1] for h in heads.values()}) > 1:
            raise ValueError(f"expected networks of one width, found {[h.w1.shape[1] for h in heads.values()]}")
        self.EM = max(h.E for h in self.heads)
        self.groups: dict[tuple[Any, ...], int] = {}
        for i, h in enumerate(self.heads):
            if h.router:
                self.groups[h.group] = self.groups.get(h.group, 0) | 1 << i
        self.routed = [i for i, h in enumerate(self.heads) if h.kind != PLAIN]
        self.ordered = [i for i, h in enumerate(self.heads) if h.kind >= SPARSE]
        self.one_order = len(self.ordered) <= 1 or all(self.heads[i].kind == LOCAL for i in self.ordered)
        self.sorted = (self.ordered[:1] if self.one_order else self.ordered) if self.ordered else []
        self.bins = 2 ** max((self.heads[i].E for i in self.ordered), default=0)
        self.places: list[int] = []  # of the tensors of each head in turn, then of the routers
        at = 0
        for h in self.heads:
            self.places.append(at)
            at += sum(_count(shape) for shape in h.shapes)
        for h in self.heads:
            self.places.append(at)
            at += sum(_count(shape) for shape in h.router)
        self.width = at
        self.launches: dict[tuple[Any, ...], triton.Launch] = {}
        self._set_constants()

    def _set_constants(self) -> None:
        H = dict(zip("OCR", self.heads))
        of = lambda *names: {f"{letter}{n}": getattr(h, f) for letter, h in H.items() for n, f in names}  # noqa: E731
        size = {"F": self.F, "H": self.H, "K": self.K, "XP": pad(self.F + 5), "HP": pad(self.H), "PRECISION": PRECISION}
        columns = {f"{letter}C": pad(self.K * C) for letter, C in zip("OCR", CHANNELS.values())}
        first = self.heads[0]
        own = {"E": first.E, "KIND": first.kind, "DISTANCE": first.distance}
        self.opacity = {**own, **size, "COLS": columns["OC"], "B": BLOCK}
        kinds = of(("E", "E"), ("KIND", "kind"), ("DISTANCE", "distance"))
        two = {name: value for name, value in {**kinds, **columns}.items() if name[0] != "O"}
        self.rest = {**two, **size, "EM": self.EM, "ONE_ORDER": self.one_order, "B": BLOCK}
        self.back = {**kinds, **of(("OUT", "outside"), ("POS", "position")), **columns, **size, "EM": self.EM}
        self.back |= {"EP": pad(self.EM), "B": BLOCK_BACKWARD, "num_warps": WARPS_BACKWARD}
        self.sums = {**kinds, **columns, **size, "EM": self.EM, "ONE_ORDER": self.one_order, "B": BLOCK_WEIGHTS}
        self.sums |= {"C_AT": self.places[1], "R_AT": self.places[2], "WIDTH": self.width, "num_warps": WARPS_WEIGHTS[pad(self.H)]}

    def launch(self, name: str, **extra: Any) -> triton.Launch:
        """Return a kernel of `triton_kernels` with its constants."""
        key = (name, *extra.values())
        found = self.launches.get(key)
        if found is None:
            sizes = {"opacity_forward": self.opacity, "shape_and_color_forward": self.rest, "heads_backward": self.back}
            found = self.launches[key] = triton.find_launch(getattr(_kernels(), name), **{**sizes.get(name, self.sums), **extra})
        return found

    def shapes(self) -> list[tuple[int, tuple[int, ...]]]:
        """Return place and shape of each tensor in an array [width]: those of `NETWORK` head by
        head, then the routers."""
        found = []
        for at, shapes in zip(self.places, [h.shapes for h in self.heads] + [h.router for h in self.heads]):
            for shape in shapes:
                found.append((at, shape))
                at += _count(shape)
        return found

    def split(self, flat: Tensor) -> list[Tensor]:
        """Return the tensors of `shapes` as views of an array [width]."""
        return [flat[at : at + _count(shape)].view(shape) for at, shape in self.shapes()]


def _count(shape: tuple[int, ...]) -> int:
    return torch.Size(shape).numel()


def _head(attribute: str, h: HeadWeights, distance: bool, F: int, K: int, constant: bool) -> KernelHead:
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
    k = (h.k or 0) if routed else 0
    kind = PLAIN if not routed else DENSE if not k else LOCAL if k == 1 and constant and not h.routed_outside else SPARSE
    shapes = tuple(tuple(getattr(h, name).shape) for name in NETWORK)
    router = tuple(tuple(t.shape) for t in (h.router_w, h.router_b) if t is not None and not h.routed_outside)
    return KernelHead(E, k, kind, h.routed_outside, distance, h.position, h.router_b is not None, shapes, router)


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


@dataclass
class AnchorView:
    """What anchors are decoded from: the inputs that have no slopes, and the tensors of the
    networks."""

    nets: KernelNetworks
    rows: Tensor  # [A] int64
    xyz: Tensor  # [N, 3]
    camera: Tensor  # [3]
    columns: Sequence[Tensor]  # feature [N, F], log_scaling [N, 6], offsets [N, K, 3]
    weights: Sequence[Tensor]  # those of NETWORK, head by head
    routers: Sequence[Tensor | None]  # weights and bias of each head
    extent: float


@dataclass
class DrawnView:
    """The Gaussians of a view, and what `pull_back` needs."""

    view: AnchorView
    routed: RoutingArrays
    order: Tensor | None
    gaussians: Gaussians
    raw: Tensor  # [A, K]
    dst: Tensor  # [A K]
    cov: Tensor  # [M, 7]


@dataclass
class Slopes:
    """Slopes of the outputs of a decode. `volume`, `hinge` and `tau` stand for slopes of two terms
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
    shared_gates: Tensor | None = None  # [3, EM]: slopes of the gates that are the same for every anchor


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
    mixed, keys = zip(*(_spread(outside[a], len(heads[a].w1)) if a in outside else (None, None) for a in ATTRIBUTES))
    means, quats, scales, opacities, colors, source, raw, *routing = _Decode.apply(
        given, keys, feature, log_scaling, offsets, *weights, *routers, *mixed
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
        drawn: DrawnView = ctx.drawn
        ctx.drawn = None
        nets, columns = drawn.view.nets, drawn.view.columns
        means, quats, scales, opacities, colors, _, raw = (g.contiguous() for g in upstream[:7])
        gates = [None if g is None else g.contiguous() for g in upstream[7:10]]
        into = [torch.zeros_like(t) for t in columns]
        flat = columns[0].new_zeros(nets.width)
        mixed = pull_back(drawn, Slopes(means, quats, scales, opacities, colors, raw, gates), into, flat)
        found = iter(nets.split(flat))
        own = [next(found) for _ in range(12)]
        routers = [next(found) if h.router and (n == 0 or h.bias) else None for h in nets.heads for n in range(2)]
        wanted = ctx.needs_input_grad[2:]
        return None, None, *(g if want else None for g, want in zip([*into, *own, *routers, *mixed], wanted))


# --- routing ------------------------------------------------------------------------------------------------------------------------------


def route(view: AnchorView, mixed: Sequence[Tensor | None] = (None,) * 3, keys: Sequence[Tensor | None] = (None,) * 3) -> RoutingArrays:
    """Return the routing of the anchors of a view.

    mixed, keys: for heads that are routed outside, the weights [A, E] and the sets of chosen
    experts [A] int32, as `_spread` returns them.
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
        sizes |= {"BINS": 0 if out.counts is None else nets.bins, "FP": pad(nets.F), "EP": pad(E), "PRECISION": PRECISION}
        tensors.append(view.rows if out.counts is None else out.counts)
        triton.launch(_routes().route, (blocks, 3), *tensors, A, stride, blocks, view.extent, **sizes)
        if not k and out.weight is not out.gates:
            for i in _bits(heads):
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


def _bits(heads: int) -> list[int]:
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


# --- decode -------------------------------------------------------------------------------------------------------------------------------


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


def pull_back(drawn: DrawnView, slopes: Slopes, into: Sequence[Tensor], flat: Tensor) -> list[Tensor | None]:
    """Write the slopes of the inputs of a view from those of its outputs.

    Args:
        drawn: The view. Only the routing of LOCAL heads may be that of the rows of the table.
        slopes: Slopes of the outputs, contiguous.
        into: Zeros of the shapes of feature, log-scaling and offsets, for their slopes.
        flat: [width], for the slopes of the networks and routers, see `KernelNetworks.shapes`.

    Returns:
        The slopes of given mixture weights [A, E] by head; None where they were not given.
    """
    view, routed, order, dst = drawn.view, drawn.routed, drawn.order, drawn.dst
    nets, rows, A = view.nets, view.rows, view.rows.shape[0]
    feature, log_scaling, offsets = view.columns
    if not A:
        flat.zero_()
        return [feature.new_zeros(0, h.E) if h.outside else None for h in nets.heads]
    d_cov, d_all = torch.empty_like(drawn.cov), torch.empty_like(drawn.raw)
    terms = bool(slopes.volume or slopes.hinge)
    given = (rows, offsets, log_scaling, drawn.raw, drawn.cov, dst, drawn.gaussians.scales, drawn.gaussians.quats)
    by = (slopes.means, slopes.quats, slopes.scales, slopes.opacities, rows if slopes.raw is None else slopes.raw)
    to = (into[2], into[1], d_cov, d_all, A, slopes.volume, slopes.hinge, slopes.tau)
    back = _place_launch("place_backward", RAW=slopes.raw is not None, TERMS=terms, K=nets.K, B=BLOCK, KP=pad(nets.K, 1))
    grid, blocks = (-(-A // BLOCK),), -(-A // BLOCK_WEIGHTS)
    back(grid, *given, *by, *to)
    d_logits = _push_features(drawn, slopes, d_all, d_cov, into[0])
    P = _parts(feature.device, nets.EM, blocks)
    parts = feature.new_empty(P, nets.width)
    weight, keys = (rows if t is None else t for t in (routed.weight, routed.keys))
    inputs = (rows, rows if order is None else order, keys, weight, view.xyz, feature, view.camera, *view.weights)
    arguments = (*inputs, dst, d_all, d_cov, slopes.colors, parts, A, routed.stride, blocks)
    nets.launch("heads_weights", BY_ROW=routed.by_row)((nets.EM, P, 3), *arguments)
    if d_logits is not None:
        for (E, _, bias, position), heads in nets.groups.items():
            sizes = {f"AT{i}": nets.places[3 + i] for i in range(3)} | {"WIDTH": nets.width, "HEADS": heads, "BIAS": bias}
            sizes |= {"POSITION": position, "F": nets.F, "E": E, "EM": nets.EM, "B": BLOCK, "EP": pad(E), "RP": pad(nets.F + 4)}
            given = (rows, view.xyz, feature, d_logits, parts, A, routed.stride, -(-A // BLOCK), view.extent)
            triton.launch(_routes().router_weights, (P, 3), *given, **sizes, PRECISION=PRECISION)
    elif nets.groups:
        parts[:, nets.places[3] :] = 0.0
    torch.sum(parts, 0, out=flat)
    if d_logits is None:
        return [None] * 3
    far = routed.stride * nets.EM
    return [d_logits[i * far : i * far + A * h.E].view(A, h.E) if h.outside else None for i, h in enumerate(nets.heads)]


def _push_features(drawn: DrawnView, slopes: Slopes, d_all: Tensor, d_cov: Tensor, d_feature: Tensor) -> Tensor | None:
    """Write the slopes of the features. Return those of the logits of all heads, or None if there
    are none."""
    view, routed, order = drawn.view, drawn.routed, drawn.order
    nets, rows, A, stride = view.nets, view.rows, view.rows.shape[0], routed.stride
    with_logits = any(h.kind in (DENSE, SPARSE) for h in nets.heads)
    d_logits = d_all.new_empty(3 * stride * nets.EM) if with_logits else None
    given = [0 if slopes.shared_gates is None and g is None else 1 for g in slopes.gates]
    mode = 2 if slopes.shared_gates is not None else int(any(given))
    d_gates: list[Tensor] = [rows] * 3
    if mode == 2:
        assert slopes.shared_gates is not None
        d_gates = [slopes.shared_gates] * 3
    elif mode == 1:
        zeros = None
        for i, (h, g) in enumerate(zip(nets.heads, slopes.gates)):
            if g is None and h.router:
                g = zeros = d_all.new_zeros(A * nets.EM) if zeros is None else zeros
            d_gates[i] = rows if g is None else g
    arrays = (rows if t is None else t for t in (routed.keys, routed.weight, routed.gates))
    routers = [rows if t is None else t for t in view.routers[0::2]]
    inputs = (*arrays, view.xyz, view.columns[0], view.camera, *routers, *view.weights, drawn.dst, d_all, d_cov, slopes.colors)
    outputs = (*d_gates, rows if d_logits is None else d_logits, d_feature, A, stride)
    passes = [7] if nets.one_order else [1, 2, 4]
    for heads in passes:
        own, ordered = rows, False
        if order is not None and any(heads >> i & 1 for i in nets.ordered):
            own, ordered = order if nets.one_order else order[_bits(heads)[0] * stride :], True
        sizes = {"HEADS": heads, "ORDERED": ordered, "BY_ROW": routed.by_row, "ADD": heads in (2, 4), "WITH_GATES": mode}
        nets.launch("heads_backward", **sizes)((-(-A // BLOCK_BACKWARD),), rows, own, *inputs, *outputs)
    return d_logits


def find_load_slopes(drawn: DrawnView, weight: float) -> Tensor:
    """Return the slopes [3, EM] of the load-balancing loss, times `weight`, in the gates of every
    anchor. They are those of eq. 7 while a head is dense, and of eq. 6 after it."""
    view, routed, nets, A = drawn.view, drawn.routed, drawn.view.nets, len(drawn.view.rows)
    blocks = -(-A // BLOCK_ROUTES)
    P = max(1, min(blocks, _units(view.rows.device)))
    parts = torch.empty(P, 3, nets.EM, device=view.rows.device)
    for (E, k, _, _), heads in nets.groups.items():
        given = (routed.gates, view.rows if routed.keys is None else routed.keys, parts, A, routed.stride, blocks)
        factor = weight * E * (1.0 if k else 2.0) / max(A, 1) ** 2
        sizes = {"E": E, "EM": nets.EM, "HEADS": heads, "SPARSE": bool(k), "B": BLOCK_ROUTES, "EP": pad(E)}
        triton.launch(_routes().load_slopes, (P, 3), *given, factor, **sizes)
    return parts.sum(0)


@cache
def _units(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 2


def _parts(device: torch.device, experts: int, blocks: int) -> int:
    """Number of programs that share the weight slopes of one expert. It depends only on the device,
    the experts and the blocks."""
    return max(1, min(blocks, 2 * _units(device) // experts))


# --- drawing without slopes ---------------------------------------------------------------------------------------------------------------


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
        mixed, keys = zip(*(_spread(outside[a], len(heads[a].w1)) if a in outside else (None, None) for a in ATTRIBUTES))
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
def _kernels() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_kernels")


@cache
def _places() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_places")


@cache
def _routes() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_routes")
