"""Anchors (Scaffold-GS): select -> cull -> decode -> Gaussians.

An anchor v lies on an integer voxel lattice. It has a feature f, a log-scaling l and K offsets O.
For a camera, three heads compute the opacity, covariance and colour of K Gaussians from f and the
viewing direction. The Gaussians lie at mu = x_v + O_v * exp(l_v)[0:3] (paper eq. 2). Anchors do not
move; `strategy.grow` adds and removes them.
"""

from __future__ import annotations

import copy
import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.errors import InputError
from scene_experts.core.parts import register
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Mode, Points
from scene_experts.geometry.neighbours import knn_d2
from scene_experts.geometry.voxel import choose_voxel_size
from scene_experts.scene import Cull, Draws, Traits
from scene_experts.scene.anchors.appearance import Codes
from scene_experts.scene.anchors.decode import DecodingScene
from scene_experts.scene.anchors.direct import DirectAnchors, explain_uncovered
from scene_experts.scene.anchors.few_views import displace, find_spacings, find_weight, left_at
from scene_experts.scene.anchors.frozen import Frozen, FrozenCuda
from scene_experts.scene.anchors.mlp import ATTRIBUTES, CHANNELS, Head
from scene_experts.scene.anchors.quantise import CLASS, KEEP, OPEN, STEPS, Steps, settle
from scene_experts.scene.anchors.select import AllAnchors, Selector, drop_masked, fade_opacities, visible_rows
from scene_experts.scene.anchors.settings import AnchorSettings
from scene_experts.scene.anchors.smoothing import find_intervals, smooth

log: logging.Logger = logging.getLogger(__name__)
NEARLY_ALL = 0.95  # the lattice has almost no effect if this share of the points is alone in its voxel


@register
@dataclass(frozen=True)
class Anchors(AnchorSettings):
    """Settings of a scene of anchors."""

    family = "anchors"

    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> AnchorScene:
        """Create a scene with one anchor per occupied voxel of the point cloud."""
        return AnchorScene.from_points(self, points, extent, cameras)

    def load(self, table: Table, meta: dict[str, Any]) -> AnchorScene:
        """Create the scene of a checkpoint with newly initialized networks."""
        scene = AnchorScene(self, table, float(meta["voxel"]), float(meta["extent"]), self.select.restore(meta), meta.get("views", ()))
        scene.steps = Steps.from_plain(meta["steps"], self.F, self.K) if "steps" in meta else None
        return scene


class AnchorScene(DecodingScene):
    """N anchors with three decoder heads.

    Columns: cell [N, 3] int64, xyz [N, 3]; feature [N, F], offsets [N, K, 3], log_scaling [N, 6].
    While a training rounds the values (`start_rounding`): keep [N, K], class [N] int64.
    """

    voxel: float

    def __init__(
        self, config: Anchors, table: Table, voxel: float, extent: float, select: Selector | None = None, views: Sequence[int] = ()
    ) -> None:
        """voxel: edge of the finest lattice cell; extent: the scene's R; both in trained world
        units. views: the training cameras' ids."""
        super().__init__(table, extent)
        self.config, self.voxel, self.dense_until = config, voxel, config.dense_until
        self.select, self.steps = select or AllAnchors(), None
        heads: dict[str, nn.Module] = {}
        for attribute in ATTRIBUTES:
            inputs = config.mix.width(config.F) + 3 + (attribute in config.add_dist) + (config.appearance if attribute == "color" else 0)
            heads[attribute] = config.decoder.build(attribute, inputs, config.hidden, config.K * CHANNELS[attribute], config.F)
        self.heads: Mapping[str, Head] = nn.ModuleDict(heads)  # type: ignore[assignment]
        self.bank = config.mix.build(config.F)
        self.codes = Codes(config.appearance, views) if config.appearance else None
        self.cameras: tuple[Camera, ...] = ()  # of the training views, for the smoothing filter of new anchors
        self.few_weight = 1.0  # factor of dropout and jitter, see `find_weight`
        self.spacings: dict[int, float] = {}  # by camera id, see `find_spacings`; empty without view_jitter

    @property
    def traits(self) -> Traits:
        return Traits(
            self.config.family,
            "anchors",
            self.voxel,
            experts=max(head.experts for head in self.heads.values()),
            dense_until=self.dense_until,
            levels=self.select.count,
            activation=True,
            appearance=self.config.appearance,
        )

    @property
    def positions(self) -> Tensor:
        return self.table.facts["xyz"]

    @property
    def file_values(self) -> int:
        """Number of float32 values per anchor in a Scaffold-GS file: 79 for K = 10, F = 32."""
        return 3 + 3 + 3 * self.K + self.config.F + 1 + 6 + 4  # position, normal, offsets, feature, opacity, scaling, rotation

    def meta(self) -> dict[str, Any]:
        views = {"views": list(self.codes.views)} if self.codes else {}
        steps = {"steps": self.steps.plain()} if self.steps is not None else {}
        return {"voxel": self.voxel, "extent": self.extent, **self.select.meta(), **views, **steps}

    @classmethod
    def from_points(cls, config: Anchors, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> AnchorScene:
        """Create one anchor per occupied voxel of the point cloud, on each level. Raises InputError
        if there are no points."""
        if len(points.xyz) == 0:
            raise InputError("expected 3D points to start from, found none; run structure from motion again or use --init random")
        voxel = config.voxel_size or choose_voxel_size(points.xyz, config.voxel_rule)
        facts, voxel, select = config.select.begin(points.xyz, voxel, cameras)
        chosen = config.voxel_size or config.voxel_rule != "neighbours"
        if chosen and not select.count and len(facts["xyz"]) > NEARLY_ALL * len(points.xyz):
            log.warning("voxels of %.4g units keep nearly every point (%d of %d)", voxel, len(facts["xyz"]), len(points.xyz))
        scale = knn_d2(facts["xyz"].float().double()).clamp_min(1e-7).sqrt().log().float()
        n = len(scale)
        params = {
            "feature": torch.zeros(n, config.F),
            "offsets": torch.zeros(n, config.K, 3),
            "log_scaling": scale[:, None].repeat(1, 6),
        }
        table = Table(params, {**facts, "xyz": facts["xyz"].float()})
        return cls(config, table, voxel, extent, select, [c.id for c in cameras])

    def set_training_cameras(self, cameras: Sequence[Camera]) -> None:
        """Give the scene the cameras of its training views. The smoothing filter, the dropout and
        the jitter need them."""
        self.few_weight = find_weight(self.config.few_views, len(cameras))
        self.spacings = find_spacings(cameras) if self.config.view_jitter else {}
        if not self.config.smoothing:
            return
        self.cameras = tuple(cameras)
        if "interval" not in self.table.facts:
            self.table.facts["interval"] = find_intervals(self.table.facts["xyz"], self.cameras)

    def begin_iteration(self, before: int, step: int, companions: Callable[[Tensor], list[Tensor]]) -> None:
        for head in self.heads.values():
            head.begin(before, step, lambda: self.table.whole_fact("xyz") / self.extent, companions)

    def new_rows(self, cells: Tensor, size: float, feature: Tensor, level: int = 0) -> dict[str, Tensor]:
        """Return rows for new anchors at lattice cells [n, 3] of `level`, with scaling `size`,
        features [n, F] and zero offsets."""
        n = len(cells)
        facts = self.select.places(cells, self.voxel, level)
        if "interval" in self.table.facts:
            facts = {**facts, "interval": find_intervals(facts["xyz"].to(feature.dtype), self.cameras)}
        if "slots" in self.table.facts:
            facts = {**facts, "slots": torch.ones(n, self.K, dtype=torch.bool, device=cells.device)}
        if CLASS in self.table.facts:
            facts = {**facts, CLASS: torch.zeros_like(cells[:, 0])}
        masks = {KEEP: feature.new_full((n, self.K), OPEN)} if KEEP in self.table.params else {}
        return {
            **masks,
            **{name: value.to(feature.dtype) if value.is_floating_point() else value for name, value in facts.items()},
            "feature": feature,
            "offsets": feature.new_zeros(n, self.K, 3),
            "log_scaling": feature.new_full((n, 6), math.log(size)),
        }

    @torch.no_grad()
    def slot_points(self, slots: Tensor, rows: Tensor) -> Tensor:
        scaling = self.table.params["log_scaling"][:, :3].contiguous().exp().index_select(0, rows)
        offsets = self.table.params["offsets"].view(-1, 3).index_select(0, slots)
        return self.table.facts["xyz"].index_select(0, rows).double() + (offsets * scaling).double()

    def forward(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        """Return the Gaussians visible from `camera` at `step`. `cull(means, scales, camera)` is
        the rasteriser's visibility test."""
        rows, seen_from = self.choose(camera, step, mode, cull)
        return self.finish(self.decode(rows, seen_from, step, mode), camera, step, mode)

    def choose(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> tuple[Tensor, Camera]:
        """Return the rows [A] that are decoded for `camera` at `step`, and the camera that they are
        decoded for."""
        seen_from, config, share = camera, self.config, 0.0
        weight = self.few_weight * left_at(step, *config.few_fall) if mode is Mode.TRAIN else 0.0
        if config.dropout and weight:
            share = config.dropout * weight * min(1.0, step / config.dropout_full)
        rows = self.visible(camera, step, mode, cull, share)
        if config.view_jitter and weight:
            seen_from = displace(camera, config.view_jitter * weight * self.spacings.get(camera.id, 0.0))
        return rows, seen_from

    def finish(self, decoded: Decoded, camera: Camera, step: int, mode: Mode) -> Decoded:
        """Apply what acts on decoded Gaussians alone: fading levels, masked slots, smoothing."""
        table = self.table
        decoded = fade_opacities(decoded, self.select.fade(table, decoded.rows, camera, step, mode), len(table), self.K)
        decoded = drop_masked(decoded, table.facts.get("slots"))
        return smooth(decoded, table.facts.get("interval"), self.config.smoothing, self.K)

    @property
    def changes_drawn(self) -> bool:
        """Whether `finish` may change a view."""
        return self.select.fades or "slots" in self.table.facts or "interval" in self.table.facts

    def direct(self, step: int, load: bool) -> DirectAnchors | str:
        weights = {a: self.heads[a].weights(step) for a in ATTRIBUTES}
        if why := self.why_composed(weights) or ("--scene.decode composed" if self.config.decode == "composed" else ""):
            return why
        if self.rounding is not None:
            return "values that are rounded"
        if not all(head.in_two_phases for head in self.heads.values()):
            return "a decoder with phases of its own"
        return explain_uncovered(weights) or DirectAnchors(self, weights, load)

    def visible(self, camera: Camera, step: int, mode: Mode, cull: Cull, dropped: float = 0.0) -> Tensor:
        """Return the rows [A] that `camera` sees at `step`, without a random share `dropped` of
        them."""
        table = self.table
        sizes = table.params["log_scaling"].detach()[:, :3]
        scales = (sizes if sizes.is_cuda else sizes.contiguous()).exp()  # takes 7 times as long on a CPU where they are not contiguous
        return visible_rows(self.select(table, camera, step, mode), table.facts["xyz"], scales, camera, cull, dropped)

    def with_table(self, table: Table) -> AnchorScene:
        """Return a scene with the same networks and the anchors of `table`."""
        scene = copy.copy(self)
        scene._modules = {**self._modules, "table": table}
        return scene

    def start_rounding(self, steps: Tensor, classes: Tensor, scale: float = 1.0) -> None:
        """Draw values from now on as a compact file would hold them, with masks that are all open.
        steps: [F + 6 + 3 K]; classes: [N] int64; scale: of the world, `data.views.World`."""
        table = self.table
        self.steps = Steps(steps, scale).to(table.device)
        table.params[KEEP] = nn.Parameter(table.params["offsets"].new_full((len(table), self.K), OPEN))
        table.facts[CLASS] = classes.to(table.device)
        if table.averages:
            table.averages[KEEP] = table.params[KEEP].detach().clone()

    def forget_rounding(self) -> None:
        self.steps = None
        self.table.facts.pop(CLASS, None)

    @torch.no_grad()
    def settled(self) -> AnchorScene:
        rounding = self.rounding
        if rounding is None or self.steps is None:
            return self
        return self.with_table(settle(self.table, rounding, self.steps.by_column(self.config.F)))

    def end_batch(self, views: int) -> None:
        for head in self.heads.values():
            head.end_batch(views)

    def rows_by_level(self) -> list[int]:
        """Return the number of anchors per level of detail, coarse to fine. Empty without
        levels."""
        return self.table.facts["level"].bincount().tolist() if self.select.count else []

    @contextmanager
    def at_level(self, level: int | None) -> Iterator[None]:
        """Context manager in which the scene draws no level finer than `level`. See
        `Scene.at_level`."""
        whole = self.select
        self.select = whole.with_cap(level)
        try:
            yield
        finally:
            self.select = whole

    def frozen(self, step: int) -> Draws:
        """Return the scene with precomputed routing if the native decode supports it, otherwise the
        scene itself."""
        weights = self.fused_weights(step) if len(self.table) and self.rounding is None else None
        if weights is None:
            return self
        return (Frozen if self.table.device.type == "cpu" else FrozenCuda)(self, weights, step)

    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        """Return the parameters by learning rate name: one group per column, head and router."""
        groups = {name: [self.table.params[name]] for name in ("feature", "offsets", "log_scaling")}
        if self.steps is not None and self.rounding is not None:
            groups |= {KEEP: [self.table.params[KEEP]], STEPS: [self.steps.log_steps]}
        for attribute in ATTRIBUTES:
            head = self.heads[attribute]
            groups[attribute] = head.network_parameters()
            if routers := head.router_parameters():
                groups[f"{attribute}.router"] = routers
        if self.bank is not None:
            groups["mix"] = list(self.bank.parameters())
        if self.codes is not None:
            groups["appearance"] = [self.codes.table]
        return groups

    def network_tensors(self) -> dict[str, Tensor]:
        """Return all tensors of the decoder by name (`opacity.w1`, ...), for files."""
        parts = {attribute: head.tensors() for attribute, head in self.heads.items()}
        parts |= {name: dict(m.named_parameters()) for name, m in (("mix", self.bank), ("appearance", self.codes)) if m is not None}
        return {f"{part}.{name}": p for part, found in parts.items() for name, p in found.items()}
