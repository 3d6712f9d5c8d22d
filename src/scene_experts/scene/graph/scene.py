"""Points that aggregate features over a graph (Ververas et al., SAGS: Structure-Aware 3D Gaussian
Splatting, ECCV 2024).

Each row is one Gaussian: a fixed point with a feature and a log-scaling. For each camera, the
features of the visible points are blended along their graph and concatenated with their
element-wise maximum and with the hash grid's features at the point. Four small networks without
biases decode the result into the Gaussian.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.fields import Count, CountOrNone, NotNegative
from scene_experts.core.parts import register
from scene_experts.core.schedule import Rate
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Points
from scene_experts.geometry.curvature import curvature, find_flat, find_midpoint_pairs
from scene_experts.geometry.neighbours import knn_d2
from scene_experts.geometry.voxel import VoxelChoice, choose_voxel_size, coarsen, find_unique_cells, to_lattice
from scene_experts.native import triton
from scene_experts.scene import OPACITY, Cull, LatticeScene, LearningRates, SceneConfig, Traits
from scene_experts.scene.anchors.decode import EPS
from scene_experts.scene.anchors.mlp import CHANNELS
from scene_experts.scene.anchors.select import visible_rows
from scene_experts.scene.graph import fused
from scene_experts.scene.graph.hash_grid import Grid, HashGrid
from scene_experts.scene.graph.network import Graph, blend_neighbours

PROBES = 1000  # approximate number of points that `face` evaluates
VIEW = 4  # columns of the direction and the distance
HALF = 2  # midpoints lie on a lattice of half the voxel size


@register
@dataclass(frozen=True)
class GraphPoints(SceneConfig):
    """Settings of a scene of points with a graph."""

    family = "graph"

    F: Count = 32
    """Number of feature channels per point."""
    hidden: Count = 32
    """Width of the networks of opacity, colour and covariance (two hidden layers)."""
    offset_hidden: Count = 64
    """Width of the offset network (one hidden layer, no activation)."""
    neighbours: Count = 10
    """Number of points in a neighbourhood, including the point itself, for the graph and the
    curvature."""
    blend: float = 0.5
    """Weight of the neighbours in the feature of a point."""
    low: Count = 10
    """Flat regions: number of nearest points, including the point itself, to which midpoints are
    added."""
    high: CountOrNone = 5
    """Other regions: number of nearest points to which midpoints are added (SAGS's scripts use 2 to
    8)."""
    flat_sigmas: float = 1.0
    """A point is in a flat region if its curvature is this many standard deviations below the
    mean."""
    voxel_size: NotNegative = 0.0
    """Edge of the finest voxels in trained units; 0 lets voxel_rule choose it."""
    voxel_rule: VoxelChoice = "neighbours"
    """neighbours: a quarter of the median distance to the nearest neighbours. squared_median and
    median_nn: the rule of Scaffold-GS as implemented and as documented."""
    grid: HashGrid = HashGrid()

    @property
    def grown_as(self) -> str:
        return "graph points"

    @property
    def has(self) -> frozenset[str]:
        return frozenset({OPACITY})

    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> GraphScene:
        """Create points at the occupied voxels of the cloud and midpoints between them. Raises
        InputError if the cloud is empty."""
        if len(points.xyz) == 0:
            raise InputError("expected 3D points to start from, found none; run structure from motion again or use --init random")
        voxel = self.voxel_size or choose_voxel_size(points.xyz, self.voxel_rule)
        cells, _ = find_unique_cells(to_lattice(points.xyz, voxel))
        flat = find_flat(curvature(cells.double(), self.neighbours), self.flat_sigmas)
        twice = cells[find_midpoint_pairs(cells.double(), flat, self.low, self.high)].sum(1)  # in half voxels
        xyz = (twice.double() * (voxel / HALF)).float()
        scale = knn_d2(xyz.double()).clamp_min(1e-7).sqrt().log().float()
        params = {"feature": torch.zeros(len(xyz), self.F), "log_scaling": scale[:, None].repeat(1, 6)}
        low, high = xyz.amin(0), xyz.amax(0)
        edge = max(float((high - low).max()), voxel)
        corner = tuple(float(v) for v in (low + high - edge) / 2)
        scene = GraphScene(self, Table(params, {"cell": coarsen(twice, HALF), "xyz": xyz}), voxel, extent, corner, edge)
        scene.face(cameras)
        return scene

    def shapes(self) -> dict[str, tuple[int, ...]]:
        return {"params.feature": (self.F,), "params.log_scaling": (6,), "facts.cell": (3,), "facts.xyz": (3,)}

    def load(self, table: Table, meta: dict[str, Any]) -> GraphScene:
        """Build the scene of a checkpoint, with newly initialised networks."""
        corner, edge = tuple(float(v) for v in meta["grid_low"]), float(meta["grid_edge"])
        return GraphScene(self, table, float(meta["voxel"]), float(meta["extent"]), corner, edge)


class Unbiased(nn.Module):
    """Linear layers without biases, with Glorot uniform initialisation."""

    layers: nn.ParameterList

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.layers = nn.ParameterList(nn.init.xavier_uniform_(torch.empty(b, a)) for a, b in pairwise(sizes))

    def product(self) -> Tensor:
        """Product of all layers without activations, [out, in]."""
        out = self.layers[0]
        for layer in list(self.layers)[1:]:
            out = layer @ out
        return out

    def after_first(self, h: Tensor) -> Tensor:
        """Apply the remaining layers to the output of the first layer, with a ReLU before each of
        them."""
        for layer in list(self.layers)[1:]:
            h = functional.linear(functional.relu(h), layer)
        return h


class GraphScene(LatticeScene):
    """N points, one Gaussian each. Columns: cell [N,3] int64, xyz [N,3]; feature [N,F], log_scaling
    [N,6]."""

    config: GraphPoints
    voxel: float
    grid: Grid
    alpha: nn.Parameter
    beta: nn.Parameter
    offsets: Unbiased

    @property
    def traits(self) -> Traits:
        return Traits(self.config.family, "points", self.voxel, activation=True)

    @property
    def K(self) -> int:
        return 1

    @property
    def positions(self) -> Tensor:
        return self.table.facts["xyz"]

    @property
    def file_values(self) -> int:
        """Number of float32 values per row in a file: position, normal, feature, opacity, scaling,
        rotation (SAGS's layout)."""
        return 3 + 3 + self.config.F + 1 + 6 + 4

    def __init__(self, config: GraphPoints, table: Table, voxel: float, extent: float, corner: tuple[float, ...], edge: float) -> None:
        """voxel: edge of the finest lattice cell; extent: the scene's R; corner, edge: the hash
        grid's cube; in trained world units."""
        super().__init__(table, extent)
        self.config, self.voxel = config, voxel
        self.grid = config.grid.build(corner, edge)
        width = 2 * config.F + config.grid.width
        self.alpha, self.beta = nn.Parameter(torch.ones(width)), nn.Parameter(torch.zeros(width))
        inner = [width + VIEW, config.hidden, config.hidden]
        heads = {name: Unbiased([*inner, size]) for name, size in CHANNELS.items()}
        self.heads: Mapping[str, Unbiased] = nn.ModuleDict(heads)  # type: ignore[assignment]
        self.offsets = Unbiased([width, config.offset_hidden, 3])
        self._graph: tuple[Tensor, Graph] | None = None  # the positions and the graph built from them

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        """Move the tensors, as for `.to(...)`, and the graph with them. If the dtype of the
        positions changes, the graph is discarded and built on its next use."""
        before, graph = self.table.facts["xyz"], self._graph
        super()._apply(fn, recurse)
        after, self._graph = self.table.facts["xyz"], None
        if graph is not None and graph[0] is before and after.dtype == before.dtype:
            self._graph = after, graph[1].change(fn)
        return self

    def meta(self) -> dict[str, Any]:
        return {"voxel": self.voxel, "extent": self.extent, "grid_low": list(self.grid.low), "grid_edge": self.grid.edge}

    def new_rows(self, cells: Tensor, size: float, feature: Tensor, level: int = 0) -> dict[str, Tensor]:
        """Columns of new points at lattice cells [n, 3] with scaling `size` and features [n, F]."""
        xyz = (cells.double() * self.voxel).to(feature.dtype)
        return {"cell": cells, "xyz": xyz, "feature": feature, "log_scaling": feature.new_full((len(cells), 6), math.log(size))}

    @torch.no_grad()
    def face(self, cameras: Sequence[Camera]) -> None:
        """Flip the sign of the opacity network if its initial opacities are negative on average
        over the cameras.

        The initial features are zero and the network has no biases, so its inputs are mostly
        distances, and the opacities have the same sign for most points. Points with negative
        opacities are not drawn and would get no gradient.
        """
        rows = torch.arange(0, len(self.table), max(1, len(self.table) // PROBES))
        own, strongest = self.encode(rows)
        raw = [self.opacity(torch.cat([own, self.view(rows, camera)], dim=1), strongest).mean() for camera in cameras]
        if raw and float(torch.stack(raw).mean()) < 0:
            next(reversed(list(self.heads["opacity"].parameters()))).neg_()

    def graph(self) -> Graph:
        """Graph of all points. It is built on its first use and after rows are added or
        removed."""
        xyz = self.table.facts["xyz"]
        if self._graph is not None and self._graph[0] is not xyz:
            self._graph = (xyz, self._graph[1]) if _equals(self._graph[0], xyz) else None  # frees its memory before the next is built
        if self._graph is None:
            self._graph = xyz, Graph.of(xyz, self.config.neighbours)
        return self._graph[1]

    def forward(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        """Decode the Gaussians that `camera` sees. `cull(means, scales, camera)` is the
        rasteriser's visibility test."""
        table = self.table
        rows = visible_rows(None, table.facts["xyz"], table.params["log_scaling"].detach()[:, :3].exp(), camera, cull)
        return self.decode(rows, camera)

    def encode(self, rows: Tensor, told: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """Inputs of the networks for the points `rows` [A], from their subgraph.

        Returns the inputs of each point [A, grid + F] and the shared maximum of the features [F].
        With `told` [P], the inputs are those of `rows[told]` only, [P, grid + F].
        """
        if self._on_cuda:
            own, strongest = self._encode_on_cuda(rows, None)
            return own if told is None else own.index_select(0, told), strongest
        feature = self.table.params["feature"].index_select(0, rows)
        near = blend_neighbours(feature, *self.graph().among(rows), self.config.blend)
        strongest = feature.amax(0) if len(rows) else feature.new_zeros(self.config.F)
        if told is not None:
            near, rows = near.index_select(0, told), rows.index_select(0, told)
        return torch.cat([self.grid(self.table.facts["xyz"].index_select(0, rows)), near], dim=1), strongest

    @property
    def _on_cuda(self) -> bool:
        return triton.covers(self.table.params["feature"], self.table.facts["xyz"], self.grid.table)

    def _encode_on_cuda(self, rows: Tensor, position: Tensor | None) -> tuple[Tensor, Tensor]:
        """The inputs [A, grid + F] and the maximum of the features; with the position of a camera,
        the views [A, 4] in the last columns."""
        feature, xyz = self.table.params["feature"], self.table.facts["xyz"]
        return fused.encode(feature, self.grid, self.graph(), xyz, rows, self.config.blend, position)

    def inputs(self, rows: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
        """Inputs of the networks of opacity, colour and covariance [A, grid + F + 4] for the points
        `rows` [A], and the shared maximum of the features [F]."""
        if self._on_cuda:
            return self._encode_on_cuda(rows, camera.position)
        own, strongest = self.encode(rows)
        return torch.cat([own, self.view(rows, camera)], dim=1), strongest

    def fold(self, weight: Tensor, strongest: Tensor) -> tuple[Tensor, Tensor]:
        """Fold the affine layer and the shared features into a first layer `weight` [H, 2 F + grid
        (+ 4 view channels)].

        Returns a weight [H, grid + F (+ 4)] and a bias [H] that give weight ([own, strongest] alpha
        + beta). This avoids scaling tensors of size A, and it multiplies the shared features only
        once. On CUDA the weight has the view channels in any case, 0 if `weight` has none.
        """
        width, own = len(self.alpha), len(self.alpha) - self.config.F
        if triton.covers(weight, strongest):
            return fused.fold(weight, self.alpha, self.beta, strongest, own + VIEW)
        encoded = weight[:, :width] * self.alpha
        bias = encoded[:, own:] @ strongest + weight[:, :width] @ self.beta
        return torch.cat([encoded[:, :own], weight[:, width:]], dim=1), bias

    def opacity(self, x: Tensor, strongest: Tensor) -> Tensor:
        """Raw opacities [A, 1], in [-1, 1], for the inputs and views x [A, grid + F + 4]."""
        head = self.heads["opacity"]
        return head.after_first(functional.linear(x, *self.fold(head.layers[0], strongest))).tanh()

    def offset(self, own: Tensor, strongest: Tensor) -> Tensor:
        """Offsets [A, 3], in units of the scaling, for the inputs own [A, grid + F (+ 4)], without
        or with the view channels, which do not matter."""
        weight, bias = self.fold(self.offsets.product(), strongest)
        if own.shape[1] != weight.shape[1]:
            columns = min(own.shape[1], weight.shape[1])
            own, weight = own[:, :columns], weight[:, :columns]
        return functional.linear(own, weight, bias)

    def decode(self, rows: Tensor, camera: Camera) -> Decoded:
        """Decode the given points [A]. Shape and colour are computed only for Gaussians with
        positive opacity."""
        x, strongest = self.inputs(rows, camera)
        raw = self.opacity(x, strongest)
        keep = (raw > 0).view(-1).nonzero().squeeze(1)
        x, source = x.index_select(0, keep), rows.index_select(0, keep)
        cov, color = (self.heads[name] for name in ("cov", "color"))
        first = functional.linear(x, *self.fold(torch.cat([cov.layers[0], color.layers[0]]), strongest))  # both in one matrix product
        shape, rgb = (head.after_first(h) for head, h in zip((cov, color), first.chunk(2, dim=1)))
        offset = self.offset(x, strongest)
        return Decoded(self.place(keep, source, offset, shape, rgb, raw), rows, raw, {})

    def place(self, keep: Tensor, source: Tensor, offset: Tensor, shape: Tensor, color: Tensor, raw: Tensor) -> Gaussians:
        """Gaussians of the drawn points, from the outputs of the networks.

        Args:
            keep: Indices of the drawn points [M] among the visible ones.
            source: Their rows [M].
            offset: Offsets [M, 3] in units of the scaling.
            shape: Raw scales and quaternions [M, 7].
            color: Raw colours [M, 3].
            raw: Opacities [A, 1] of all visible points.
        """
        xyz, log_scaling = self.table.facts["xyz"], self.table.params["log_scaling"]
        if triton.covers(xyz, log_scaling, offset):
            means, quats, scales, opacities, colors = fused.place(keep, source, xyz, log_scaling, offset, shape, color, raw)
            return Gaussians(means, quats, scales, opacities, colors, source)
        scaling = log_scaling.index_select(0, source).exp()
        return Gaussians(
            means=xyz.index_select(0, source) + offset * scaling[:, :3],
            quats=functional.normalize(shape[:, 3:], dim=1, eps=EPS),
            scales=scaling[:, 3:] * shape[:, :3].sigmoid(),
            opacities=raw.view(-1).index_select(0, keep),
            colors=color.sigmoid(),
            source=source,
        )

    def view(self, rows: Tensor, camera: Camera) -> Tensor:
        """Unit direction from the camera to each point, and distance, [A, 4]."""
        v = self.table.facts["xyz"].index_select(0, rows) - camera.position.to(self.table.facts["xyz"])
        distance = v.norm(dim=1, keepdim=True)
        return torch.cat([v / distance.clamp_min(EPS), distance], dim=1)

    @torch.no_grad()
    def slot_points(self, slots: Tensor, rows: Tensor) -> Tensor:
        """Positions [P, 3] float64 of the Gaussians of `rows` [P]. Uses the whole graph, because
        there is no camera."""
        everyone = torch.arange(len(self.table), device=rows.device)
        offset = self.offset(*self.encode(everyone, rows)) * self.table.params["log_scaling"].index_select(0, rows)[:, :3].exp()
        return self.table.facts["xyz"].index_select(0, rows).double() + offset.double()

    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        """All parameters, grouped by the name of their learning rate."""
        groups = {name: [self.table.params[name]] for name in ("feature", "log_scaling")}
        groups |= {name: list(head.parameters()) for name, head in self.heads.items()}
        return groups | {"offsets": list(self.offsets.parameters()), "grid": [self.grid.table], "affine": [self.alpha, self.beta]}

    def network_tensors(self) -> dict[str, Tensor]:
        """All learned tensors that are not columns of the table, by name (`opacity.0`,
        `grid.table`, ...), for files."""
        named = {**dict(self.heads.items()), "offsets": self.offsets}
        layers = {f"{name}.{i}": layer for name, head in named.items() for i, layer in enumerate(head.parameters())}
        return {**layers, "grid.table": self.grid.table, "affine.alpha": self.alpha, "affine.beta": self.beta}


def _equals(a: Tensor, b: Tensor) -> bool:
    """Whether two columns of positions are equal. The host waits for the device only if their
    shapes are."""
    return a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


@register
@dataclass(frozen=True)
class GraphRates(LearningRates):
    """Learning rates of SAGS."""

    family = "graph"

    feature: Rate = Rate(0.0075, 0.0075)
    """Learning rate of the point features."""
    log_scaling: Rate = Rate(0.007, 0.007)
    """Learning rate of the point sizes."""
    opacity: Rate = Rate(0.002, 0.00002)
    """Learning rate of the opacity network."""
    cov: Rate = Rate(0.004, 0.00004)
    """Learning rate of the covariance network."""
    color: Rate = Rate(0.008, 0.00005)
    """Learning rate of the colour network."""
    offsets: Rate = Rate(0.005, 0.001)
    """Learning rate of the offset network."""
    grid: Rate = Rate(0.005, 0.001)
    """Learning rate of the hash grid."""
    affine: Rate = Rate(0.005, 0.001)
    """Learning rate of the affine layers."""

    def at(self, group: str, step: int, total: int, extent: float) -> float:
        """Learning rate of `group`, a key of `rate_groups`, at `step` of `total`."""
        rate: Rate = getattr(self, group)
        return rate.at(step, total)
