"""Settings of scenes of anchors."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from scene_experts.core.fields import SCALES, Count, CountOrNone, Flag, NotNegative, Range, Scales, With
from scene_experts.geometry.voxel import VoxelChoice
from scene_experts.scene import CODES, OPACITY, SceneConfig
from scene_experts.scene.anchors.features import FeatureMix, OwnFeature
from scene_experts.scene.anchors.few_views import find_weight
from scene_experts.scene.anchors.mlp import Attribute, Decoder, Plain
from scene_experts.scene.anchors.select import AllAnchors, Selection


@dataclass(frozen=True)
class AnchorSettings(SceneConfig):
    """What a scene of anchors is made of."""

    K: Count = 10
    """Number of Gaussians per anchor."""
    F: Count = 32
    """Number of feature channels per anchor."""
    hidden: Count = 32
    """Width of the decoder networks."""
    add_dist: tuple[Attribute, ...] = ()
    """Attributes whose networks also receive the distance to the camera."""
    voxel_size: NotNegative = 0.0
    """Edge of the finest voxels in trained units; 0 lets voxel_rule choose it."""
    voxel_rule: VoxelChoice = "neighbours"
    """neighbours: a quarter of the median distance to the nearest neighbours. squared_median and
    median_nn: the rule of Scaffold-GS as implemented and as documented."""
    decode: Literal["auto", "composed", "native"] = "auto"
    """Implementation that decodes anchors: native (fused), composed (PyTorch), or auto (native if
    it supports the scene)."""
    decoder: Decoder = Plain()
    """The networks that turn features into Gaussians."""
    select: Selection = AllAnchors()
    """Which anchors a camera uses."""
    mix: FeatureMix = OwnFeature()
    """What the decoders see of an anchor's feature."""
    appearance: CountOrNone = 0
    """Size of the appearance code per training view; 0 means no codes."""
    dropout: Annotated[float, Range(0, below=1)] = 0.0
    """Share of the anchors that a training view leaves out from iteration `dropout_full` on; it
    rises linearly from 0. Meant for few photographs (after DropGaussian, Park et al. 2025)."""
    dropout_full: Annotated[int, Range(1), Scales(least=1), With(("dropout",))] = 30_000
    """Iteration at which the share of dropped anchors is reached. --iterations rescales it."""
    view_jitter: NotNegative = 0.0
    """Training views are decoded as seen from a random position around their camera. Its root mean
    square distance from the camera, as a share of the distance to the nearest other training
    cameras; 0 means no displacement."""
    few_views: Annotated[CountOrNone, With(("dropout", "view_jitter"))] = 0
    """Number of training views up to which dropout and view_jitter have their whole value. Both
    fall linearly to 0 at twice as many views; 0: the same values for any number of views."""
    few_fall: Annotated[tuple[int, int], Range(0), SCALES, With(("dropout", "view_jitter"))] = (0, 0)
    """Iterations between which dropout and view_jitter fall linearly to nothing; 0 0: they stay.
    --iterations rescales them."""
    smoothing: NotNegative = 0.0
    """Variance of the 3D smoothing filter in squared pixels of the closest training view (0.2 in
    Mip-Splatting); 0 means no filter. It helps cameras that come closer than the training views."""

    @property
    def grown_as(self) -> str:
        return "anchors on levels" if self.select.has_levels else "anchors"

    @property
    def dense_until(self) -> int:
        return self.decoder.dense_until

    @property
    def can_round(self) -> bool:
        return True

    @property
    def has(self) -> frozenset[str]:
        return self.decoder.has | {OPACITY} | ({CODES} if self.appearance else set())

    def phases(self) -> dict[str, int]:
        return {"decoder.warmup": self.dense_until, **{f"select.{name}": last for name, last in self.select.phases().items()}}

    def needs_whole_table(self) -> str:
        return "anchors on levels" if self.select.has_levels else ""

    def of_views(self, views: int) -> Self:
        weight = find_weight(self.few_views, views)
        fixed = replace(self, few_views=0, dropout=self.dropout * weight, view_jitter=self.view_jitter * weight)
        return self if weight == 1 else fixed  # 1: with fewer views too

    def shapes(self) -> dict[str, tuple[int, ...]]:
        levels: dict[str, tuple[int, ...]] = {"facts.level": (), "facts.extra_level": ()} if self.select.has_levels else {}
        params = {"params.feature": (self.F,), "params.offsets": (self.K, 3), "params.log_scaling": (6,)}
        return {**params, "facts.cell": (3,), "facts.xyz": (3,), **levels}

    def check(self, flag: Flag) -> None:
        self.mix.check_size(self.F)
