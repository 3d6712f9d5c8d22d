"""The networks and the anchors of a view as the Triton kernels of the decode take them."""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from types import ModuleType
from typing import Any

import torch
from torch import Tensor

from scene_experts.native import triton
from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, HeadWeights

NETWORK = ("w1", "b1", "w2", "b2")
TENSORS = ("router_w", "router_b", *NETWORK)
PLAIN, DENSE, SPARSE, LOCAL = 0, 1, 2, 3
PRECISION = "ieee"  # of matrix products: "ieee" is float32, "tf32x3" is nearly float32 on tensor cores, "tf32" is less precise
BLOCK = 32  # anchors per program; with the paper's sizes, the largest block whose tiles fit in registers
BLOCK_WEIGHTS = 16  # anchors per step of `heads_weights`, which also keeps the gradients of a network in registers
BLOCK_BACKWARD = 16  # anchors per program of `heads_backward`
WARPS_BACKWARD = 8
WARPS_WEIGHTS = {16: 8, 32: 8, 64: 16}
"""Warps of `heads_backward`, and of `heads_weights` by padded hidden width: next to nothing is kept in
local memory (sm_90). For one head, 8 and 16 were four times as fast as 4 on an H100."""
MOST_EXPERTS = 30  # a set of experts is stored as the bits of an int32
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
    gradients of each tensor lie in one array."""

    def __init__(self, heads: dict[str, HeadWeights], with_dist: dict[str, bool], F: int, K: int, constant: bool = False) -> None:
        """constant: the caller has no gradients of gates. Weights of one chosen expert are then 1 and
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
class AnchorView:
    """What anchors are decoded from: the inputs that have no gradients, and the tensors of the
    networks."""

    nets: KernelNetworks
    rows: Tensor  # [A] int64
    xyz: Tensor  # [N, 3]
    camera: Tensor  # [3]
    columns: Sequence[Tensor]  # feature [N, F], log_scaling [N, 6], offsets [N, K, 3]
    weights: Sequence[Tensor]  # those of NETWORK, head by head
    routers: Sequence[Tensor | None]  # weights and bias of each head
    extent: float


@cache
def count_units(device: torch.device) -> int:
    return torch.cuda.get_device_properties(device).multi_processor_count if device.type == "cuda" else 2


@cache
def _kernels() -> ModuleType:
    return importlib.import_module("scene_experts.scene.anchors.triton_kernels")
