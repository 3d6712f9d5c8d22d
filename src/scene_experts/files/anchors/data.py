"""`AnchorData`: a scene of anchors as files hold it. The compact file and the Scaffold-GS result
folder are written from it and read into it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, LARGEST, LARGEST_LOG, expect_range
from scene_experts.files.anchors.precision import Precision
from scene_experts.scene.anchors.mlp import Attribute

Network = dict[str, Tensor]
"""One decoder network by our short names: w1 [E, H, D], b1 [E, H], w2 [E, out, H], b2 [E, out] of E
experts; with a router router_w [E, F] and router_b [E]; with more than two layers (E = 1)
middle.i.weight [H, H] and middle.i.bias [H]."""
FILE_NAMES = {"router_w": "router.weight", "router_b": "router.bias", **{name: f"experts.{name}" for name in ("w1", "b1", "w2", "b2")}}
"""Short name of a network's tensor -> its name in files. Other tensors have the same name in
both."""
_SHORT_NAMES = {long: short for short, long in FILE_NAMES.items()}


@dataclass(frozen=True)
class AnchorData:
    """N anchors with their networks, in the capture's own frame and unit."""

    columns: dict[str, Tensor]
    """xyz [N, 3], feature [N, F], offsets [N, K, 3], log_scaling [N, 6] float32; with levels of
    detail also level, extra_level, info [N]. With masked Gaussians also slots [N, K] bool: those
    that are drawn. With the smoothing filter also interval [N], in the capture's unit."""
    networks: dict[str, Tensor]
    """By name in files, as `opacity.experts.w1`: opacity, cov and color, which see distances in the
    capture's unit, and where present feature_bank and `appearance.table` [V, dim]."""
    about: dict[str, Any] | None
    """The description (scene.json): everything that the tensors do not say. None for a result of
    another program."""
    cells: Tensor | None = None
    """Lattice cells [N, 3] int64: position = cell * voxel + origin, or with levels of detail cell *
    edges[level] + origin. None: on no known lattice."""
    voxel: float = 0.0
    """Edge of a cell, of the finest with levels of detail; 0: unknown."""
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Position of cell (0, 0, 0)."""
    add_dist: tuple[Attribute, ...] = ()
    """Attributes whose network sees the distance."""
    step: int = 0
    """Iterations trained; 0: unknown."""
    settings: dict[str, Any] = field(default_factory=dict)
    """cfg_args of a result folder."""
    edges: tuple[float, ...] = ()
    """Edge of a cell of each level of detail, coarse to fine; empty: one lattice."""
    precision: Precision | None = None
    """How precisely a compact file holds it; None: finely, without regard to pictures."""

    def checked(self) -> AnchorData:
        """This scene. Raises Damaged for values of anchors and networks that are not finite or that
        no computation in float32 can bear."""
        expect_range(self.columns["xyz"], "positions", -FARTHEST, FARTHEST)
        expect_range(self.columns["log_scaling"], "logarithms of scales", -LARGEST, LARGEST_LOG)
        if "interval" in self.columns:
            expect_range(self.columns["interval"], "sampling intervals", 0, FARTHEST)
        for name in ("feature", "offsets"):
            expect_range(self.columns[name], f"values of {name}")
        for name, value in self.networks.items():
            if not value.is_floating_point():
                raise Damaged(f"a network {name} of {value.dtype}")
            expect_range(value.float(), f"weights of {name}")
        return self


def by_attribute(networks: dict[str, Tensor]) -> dict[str, Network]:
    """Networks by attribute and short name, from tensors by their name in files."""
    out: dict[str, Network] = {}
    for name, value in networks.items():
        attribute, _, rest = name.partition(".")
        out.setdefault(attribute, {})[_SHORT_NAMES.get(rest, rest)] = value
    return out


def by_file_name(networks: dict[str, Network]) -> dict[str, Tensor]:
    """The inverse of `by_attribute`."""
    return {f"{a}.{FILE_NAMES.get(name, name)}": value for a, network in networks.items() for name, value in network.items()}
