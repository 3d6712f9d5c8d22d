"""Anchor selection before the visibility filter: all anchors, or the levels of detail that match
the distance (Octree-GS)."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import Annotated, Any, ClassVar, Protocol

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.fields import SCALES, Positive, Range
from scene_experts.core.parts import Part, register
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode
from scene_experts.geometry.voxel import find_unique_cells, to_lattice
from scene_experts.scene import Cull
from scene_experts.scene.anchors import levels as lattices
from scene_experts.scene.anchors.few_views import drop_anchors, keep_at_random
from scene_experts.scene.anchors.levels import LevelRule, Levels, blend_levels, whole


class Selector(Protocol):
    """Selects the anchors to draw and defines the lattices on which anchors lie."""

    @property
    def lattices(self) -> Levels | None:
        """The levels of detail, or None if the scene has none."""
        ...

    @property
    def count(self) -> int:
        """Number of levels of detail; 0 without levels."""
        ...

    @property
    def fades(self) -> bool:
        """Whether `fade` may return factors."""
        ...

    def coarse(self, step: int) -> bool:
        """Whether coarse-to-fine training still adds finer levels after `step`."""
        ...

    def with_cap(self, level: int | None) -> Selector:
        """Return a copy that uses no level finer than `level`. None removes the cap."""
        ...

    def __call__(self, table: Table, camera: Camera, step: int, mode: Mode) -> Tensor | None:
        """Return the ascending row indices [S] int64 of the selected anchors, or None for all
        anchors."""
        ...

    def fade(self, table: Table, rows: Tensor, camera: Camera, step: int, mode: Mode) -> Tensor | None:
        """Return opacity factors [A] in [0, 1] for `rows`, or None if all factors are 1."""
        ...

    def places(self, cells: Tensor, voxel: float, level: int) -> dict[str, Tensor]:
        """Return the facts of new anchors at cells [n, 3] of `level`. Positions are float64."""
        ...

    def meta(self) -> dict[str, Any]:
        """Return the values that a checkpoint stores in addition to the table."""
        ...


@dataclass(frozen=True)
class Selection(Part, ABC):
    """Settings of anchor selection. Creates the scene's `Selector`."""

    has_levels: ClassVar[bool] = False
    """Whether anchors lie on levels of detail."""

    def phases(self) -> dict[str, int]:
        """Return the last iterations of its phases by the names of their fields, as
        `SceneConfig.phases`."""
        return {}

    @abstractmethod
    def begin(self, points: Tensor, voxel: float, cameras: Sequence[Camera]) -> tuple[dict[str, Tensor], float, Selector]:
        """Create the initial anchors from points [P, 3]. Returns the facts of the rows, the edge of
        the finest cell and the selector."""

    @abstractmethod
    def restore(self, meta: dict[str, Any]) -> Selector:
        """Restore the selector from the values of `Selector.meta()`."""


@register
@dataclass(frozen=True)
class AllAnchors(Selection):
    """Select all anchors, as in Scaffold-GS."""

    @property
    def lattices(self) -> None:
        return None

    @property
    def count(self) -> int:
        return 0

    @property
    def fades(self) -> bool:
        return False

    def coarse(self, step: int) -> bool:
        return False

    def with_cap(self, level: int | None) -> AllAnchors:
        return self

    def __call__(self, table: Table, camera: Camera, step: int, mode: Mode) -> Tensor | None:
        return None

    def fade(self, table: Table, rows: Tensor, camera: Camera, step: int, mode: Mode) -> Tensor | None:
        return None

    def places(self, cells: Tensor, voxel: float, level: int) -> dict[str, Tensor]:
        return {"cell": cells, "xyz": cells.double() * voxel}

    def meta(self) -> dict[str, Any]:
        return {}

    def begin(self, points: Tensor, voxel: float, cameras: Sequence[Camera]) -> tuple[dict[str, Tensor], float, Selector]:
        """Create one anchor per occupied voxel of points [P, 3]. Returns the row facts, the edge of
        the finest cell and the selector."""
        cells, _ = find_unique_cells(to_lattice(points, voxel))
        return self.places(cells, voxel, 0), voxel, self

    def restore(self, meta: dict[str, Any]) -> Selector:
        return self


@register
@dataclass(frozen=True)
class Octree(Selection):
    """Levels of detail (Ren et al., Octree-GS). Anchors lie on several lattices; near cameras use
    finer levels."""

    has_levels = True

    fork: Annotated[int, Range(2, lattices.MOST_FORK)] = 2
    """Subdivision factor between levels."""
    count: Annotated[int, Range(0, lattices.MOST_LEVELS)] = 0
    """Number of levels; 0 derives it from the distances between training cameras and points."""
    first: Annotated[int, Range(-1)] = -1
    """Finest level at the start of coarse-to-fine training; -1 means half of the levels."""
    base_layer: int = -1
    """Level 0 divides the scene's cube into fork^base_layer cells per axis; -1 derives it from
    coarseness."""
    coarseness: Positive = 4.0
    """Cell size of the middle level in voxels, if base_layer is -1."""
    dist_ratio: Annotated[float, Range(above=0.5, high=1)] = 0.999
    """Quantile of the camera distances that is used as the largest distance; one minus it gives the
    smallest."""
    visible_threshold: Annotated[float, Range(below=1)] = -1.0
    """Remove anchors that are selected by no larger share of the training cameras; a negative value
    means the mean share."""
    rule: LevelRule = "round"
    """How the level of detail is rounded to an integer. blend fades in the opacity of the finest
    level."""
    coarse_until: Annotated[int, Range(0), SCALES] = 10_000
    """Training starts with the coarser half of the levels and adds the finer ones one by one until
    this iteration; 0 starts with all. --iterations rescales it."""
    coarse_factor: Positive = 1.5
    """Ratio of the waiting times of successive levels in coarse-to-fine training."""
    extend: Annotated[float, Range(1)] = 1.1
    """Edge of the scene's cube, in edges of the bounding cube of the points."""

    def begin(self, points: Tensor, voxel: float, cameras: Sequence[Camera]) -> tuple[dict[str, Tensor], float, Selector]:
        """Create anchors in the occupied cells of every level and remove those that too few cameras
        select.

        Returns the facts of the rows, the edge of the finest cell and the selector.
        """
        levels = self.levels(points, voxel, cameras)
        cells, level = lattices.occupied(levels, points)
        xyz = torch.cat([levels.positions(cells[level == i], i) for i in range(levels.count)])
        if self.visible_threshold < 0:
            levels = replace(levels, threshold=float(levels.share(xyz.float(), level).mean()))
        rows = levels.wanted(xyz.float(), level).nonzero().squeeze(1)
        facts = {"cell": cells[rows], "xyz": xyz[rows], "level": level[rows], "extra_level": torch.zeros(len(rows))}
        return facts, levels.size(levels.count - 1), LevelSelector(self, levels)

    def levels(self, points: Tensor, voxel: float, cameras: Sequence[Camera]) -> Levels:
        """Create the lattices for points [P, 3] and training cameras.

        Raises InputError if there is no camera, or if an axis has more cells than the lattice can
        index.
        """
        if not cameras:
            raise InputError("expected training cameras to choose levels of detail from, found none; choose another --split")
        far, near = lattices.distances(points, cameras, self.dist_ratio)
        count = self.count or lattices.level_count(far, near, self.fork)
        low, cube = lattices.cube(points, self.extend)
        layer = self.base_layer
        if layer < 0:
            layer = round(math.log(cube / (self.coarseness * voxel), self.fork)) - count // 2 + 1
        finest = math.floor(math.log(lattices.MOST_CELLS, self.fork))
        if layer > finest:
            raise InputError(
                f"expected at most {self.fork}^{finest} cells an axis at level 0, found {self.fork}^{layer}; "
                "lower --scene.select.base-layer, or where it adapts itself, remove points far from all others"
            )
        edge = cube / float(self.fork) ** layer
        count = lattices.within_reach(count, edge, cube, self.fork)
        first = min(count // 2 if self.first < 0 else self.first, count - 1)
        threshold = max(self.visible_threshold, 0.0)
        return Levels(count, first, self.fork, edge, (low, low, low), far, self.rule, threshold, lattices.centres(cameras))

    def restore(self, meta: dict[str, Any]) -> Selector:
        return LevelSelector(self, Levels.from_meta(meta["levels"]))

    def phases(self) -> dict[str, int]:
        return {"coarse_until": self.coarse_until}

    def turns(self, levels: Levels) -> list[float]:
        """Iterations after which one more level is used. Intervals shrink by `coarse_factor`; the
        last ends at `coarse_until`."""
        m, q = levels.count - 1 - levels.first, 1.0 / self.coarse_factor
        if m < 1:
            return []
        return list(accumulate(q**i / sum(q**j for j in range(m)) * self.coarse_until for i in range(m)))


@dataclass(frozen=True)
class LevelSelector:
    """Selects the anchors whose level is no finer than the level of detail for their distance."""

    config: Octree
    lattices: Levels
    cap: int | None = None
    """No finer level than this, whatever the distance (a viewer's level of detail)."""

    def __call__(self, table: Table, camera: Camera, step: int, mode: Mode) -> Tensor:
        asked = self.asked(table.facts["xyz"], table.facts["level"], table.facts["extra_level"], camera)
        return (table.facts["level"] <= whole(asked, self.lattices.rule, self.top(step, mode))).nonzero().squeeze(1)

    def fade(self, table: Table, rows: Tensor, camera: Camera, step: int, mode: Mode) -> Tensor | None:
        if not self.fades:
            return None
        xyz, level, extra = (table.facts[name].index_select(0, rows) for name in ("xyz", "level", "extra_level"))
        asked = blend_levels(self.asked(xyz, level, extra, camera), self.top(step, mode))
        return torch.where(level == asked.floor().long(), asked.frac(), torch.ones_like(asked))

    def asked(self, xyz: Tensor, level: Tensor, extra: Tensor, camera: Camera) -> Tensor:
        """Return the real-valued levels of detail [n], including each anchor's `extra_level`."""
        return self.lattices.asked(xyz, level, camera.position) + extra

    def top(self, step: int, mode: Mode) -> int:
        """Return the number of levels in use. During coarse-to-fine training, these are the levels
        added before `step`."""
        count = self.lattices.count
        if mode is Mode.TRAIN:
            count = self.lattices.first + 1 + sum(turn < step for turn in self.config.turns(self.lattices))
        return min(count, self.lattices.count if self.cap is None else max(self.cap, 0) + 1)

    @property
    def count(self) -> int:
        return self.lattices.count

    @property
    def fades(self) -> bool:
        return self.lattices.rule == "blend"

    def with_cap(self, level: int | None) -> LevelSelector:
        """Return a copy that uses no level finer than `level`. None removes the cap."""
        return replace(self, cap=level)

    def coarse(self, step: int) -> bool:
        """Whether coarse-to-fine training still adds levels at `step`."""
        turns = self.config.turns(self.lattices)
        return bool(turns) and step <= turns[-1]

    def places(self, cells: Tensor, voxel: float, level: int) -> dict[str, Tensor]:
        n = len(cells)
        xyz = self.lattices.positions(cells, level)
        return {"cell": cells, "xyz": xyz, "level": torch.full_like(cells[:, 0], level), "extra_level": xyz.new_zeros(n)}

    def meta(self) -> dict[str, Any]:
        return {"levels": self.lattices.meta()}


def visible_rows(selected: Tensor | None, means: Tensor, scales: Tensor, camera: Camera, cull: Cull, dropped: float = 0.0) -> Tensor:
    """Return rows [A] of the selected anchors whose ellipsoid overlaps the image, without a random
    share `dropped` of them. means [N, 3], scales [N, 3]; no gradient."""
    with torch.no_grad():
        if selected is None:
            seen = cull(means, scales, camera)
            if dropped and means.is_cuda:  # one list of rows, and one wait of the host for its length, instead of two
                seen = seen & keep_at_random(len(means), dropped, means.device)
            rows = seen.nonzero().squeeze(1)
        else:
            rows = selected[cull(means.index_select(0, selected), scales.index_select(0, selected), camera)]
        return drop_anchors(rows, dropped) if dropped and not (selected is None and means.is_cuda) else rows


def fade_opacities(decoded: Decoded, fade: Tensor | None, rows: int, K: int) -> Decoded:
    """Multiply the raw and drawn opacities of `decoded` by `fade` [A]. rows: number of rows of the
    whole table."""
    if fade is None or decoded.raw_opacity is None:
        return decoded
    of_row = fade.new_ones(rows).index_copy(0, decoded.rows, fade)
    gaussians = decoded.gaussians
    factor = of_row.index_select(0, torch.div(gaussians.source, K, rounding_mode="floor"))
    gaussians = replace(gaussians, opacities=gaussians.opacities * factor)
    return replace(decoded, gaussians=gaussians, raw_opacity=decoded.raw_opacity * fade[:, None])


def drop_masked(decoded: Decoded, slots: Tensor | None) -> Decoded:
    """Leave out the Gaussians of masked slots. slots [N, K] bool: the slots that are drawn; None:
    all. Raw opacities do not change."""
    if slots is None:
        return decoded
    g = decoded.gaussians
    kept = slots.view(-1).index_select(0, g.source).nonzero().squeeze(1)
    return replace(decoded, gaussians=Gaussians(**{name: value.index_select(0, kept) for name, value in vars(g).items()}))
