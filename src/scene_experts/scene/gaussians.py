"""Explicit Gaussians (3DGS, Kerbl et al. 2023): each row is one Gaussian with its colour in
spherical harmonics.

Columns: means [N, 3], log_scales [N, 3], quats [N, 4] (w, x, y, z; normalised when decoded),
raw_opacity [N] (logits), sh_dc [N, 3] and sh_rest [N, (degree + 1)^2 - 1, 3] (spherical harmonics).
The active degree starts at 0 and increases by one every `sh_ramp` iterations.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated, Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.fields import Positive, Range, Scales
from scene_experts.core.parts import register
from scene_experts.core.schedule import Rate
from scene_experts.core.table import Table
from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Points
from scene_experts.geometry.neighbours import knn_d2
from scene_experts.geometry.sh import MAX_DEGREE, rgb_to_dc
from scene_experts.geometry.sh_colors import compute_sh_colors
from scene_experts.native import triton
from scene_experts.scene import EXPLICIT, Cull, LearningRates, Scene, SceneConfig, Traits
from scene_experts.scene.gaussians_direct import COLUMNS, DirectGaussians

FILE_VALUES = 3 + 3 + 1 + 3 + 4  # position, normal, opacity, scale and rotation in the 3DGS file, without the harmonics
_EPS = 1e-12
_ROUND = 1.001  # margin of the bounding ball in the visibility test, against rounding errors


@register
@dataclass(frozen=True)
class Explicit(SceneConfig):
    """Settings of a scene of explicit Gaussians."""

    family = "gaussians"

    sh_degree: Annotated[int, Range(0, MAX_DEGREE)] = 3
    """Highest degree of the spherical harmonics, 0 to 3."""
    sh_ramp: Annotated[int, Range(1), Scales(least=1)] = 1000
    """Iterations until the next degree is used; the first degree is 0."""
    opacity: Annotated[float, Range(above=0, below=1)] = 0.1
    """Initial opacity of every Gaussian."""
    size: Positive = 1.0
    """Initial size of a Gaussian, in mean distances to its nearest neighbours."""

    @property
    def grown_as(self) -> str:
        return "Gaussians"

    @property
    def has(self) -> frozenset[str]:
        return frozenset({EXPLICIT})

    def phases(self) -> dict[str, int]:
        return {"sh_ramp": self.sh_ramp * self.sh_degree - 1}

    def start(self, points: Points, extent: float, cameras: Sequence[Camera] = ()) -> GaussianScene:
        """Create one Gaussian per point of the cloud. Raises InputError if the cloud is empty."""
        if len(points.xyz) == 0:
            raise InputError("expected 3D points to start from, found none; run structure from motion again or use --init random")
        n = len(points.xyz)
        size = knn_d2(points.xyz.double()).clamp_min(1e-7).sqrt() * self.size
        quats = torch.zeros(n, 4)
        quats[:, 0] = 1.0
        params = {
            "means": points.xyz.float().clone(),
            "log_scales": size.log().float()[:, None].repeat(1, 3),
            "quats": quats,
            "raw_opacity": torch.full((n,), math.log(self.opacity / (1 - self.opacity))),
            "sh_dc": rgb_to_dc(points.rgb.float() / 255.0),
            "sh_rest": torch.zeros(n, (self.sh_degree + 1) ** 2 - 1, 3),
        }
        return GaussianScene(self, Table(params, {}), extent)

    def shapes(self) -> dict[str, tuple[int, ...]]:
        rest = ((self.sh_degree + 1) ** 2 - 1, 3)
        shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "raw_opacity": (), "sh_dc": (3,), "sh_rest": rest}
        return {f"params.{name}": shape for name, shape in shapes.items()}

    def load(self, table: Table, meta: dict[str, Any]) -> GaussianScene:
        """Build the scene of a checkpoint. Raises InputError if the table does not have the
        expected columns."""
        if set(table.params) != set(COLUMNS) or table.params["sh_rest"].shape[1] != (self.sh_degree + 1) ** 2 - 1:
            raise InputError("expected the columns of explicit Gaussians in the checkpoint, found others; use its own run folder")
        return GaussianScene(self, table, float(meta["extent"]))


class GaussianScene(Scene):
    """N Gaussians as rows of a table (see the module's docstring for the columns)."""

    def __init__(self, config: Explicit, table: Table, extent: float) -> None:
        """extent: the extent R of the scene, in trained world units."""
        super().__init__(table, extent)
        self.config = config

    @property
    def traits(self) -> Traits:
        return Traits(self.config.family, "Gaussians", sh_degree=self.config.sh_degree)

    @property
    def K(self) -> int:
        return 1

    @property
    def file_values(self) -> int:
        """Number of float32 values per row in the 3DGS file: 62 at degree 3."""
        return FILE_VALUES + 3 * (self.config.sh_degree + 1) ** 2

    @property
    def positions(self) -> Tensor:
        return self.table.params["means"].detach()

    def degree(self, step: int) -> int:
        """Active degree of the spherical harmonics at `step`.

        Step 0 uses the full degree: a new scene has zero higher harmonics, and a file may not
        record its iteration.
        """
        return min(self.config.sh_degree, step // self.config.sh_ramp) if step else self.config.sh_degree

    def forward(self, camera: Camera, step: int, mode: Mode, cull: Cull) -> Decoded:
        """Decode the Gaussians that may overlap the image of `camera`. `cull` is the rasteriser's
        visibility test.

        The test uses a ball with the radius of the largest axis. The ball contains the Gaussian, so
        no visible Gaussian is lost.
        """
        p = self.table.params
        return replace(self.decode(self.visible(camera, cull), camera, step), population=(p["raw_opacity"], p["log_scales"]))

    @torch.no_grad()
    def visible(self, camera: Camera, cull: Cull) -> Tensor:
        """Return the rows [A] that may overlap the image of `camera`."""
        p = self.table.params
        ball = p["log_scales"].amax(1, keepdim=True).exp_().mul_(_ROUND).expand(-1, 3)
        return cull(p["means"].detach(), ball, camera).nonzero().squeeze(1)

    def direct(self, step: int, load: bool) -> DirectGaussians | str:
        column = self.table.params["means"]
        if column.dtype != torch.float32:
            return f"tensors of {column.dtype}"
        return triton.explain_missing() or DirectGaussians(self)

    def decode(self, rows: Tensor, camera: Camera, step: int) -> Decoded:
        """Decode the given rows [A] into Gaussians, with the colours that `camera` sees at
        `step`."""
        p = self.table.params
        means = p["means"].index_select(0, rows)
        gaussians = Gaussians(
            means=means,
            quats=functional.normalize(p["quats"].index_select(0, rows), dim=1, eps=_EPS),
            scales=p["log_scales"].index_select(0, rows).exp(),
            opacities=p["raw_opacity"].index_select(0, rows).sigmoid(),
            colors=compute_sh_colors(means, p["sh_dc"], p["sh_rest"], rows, camera.position.to(means), self.degree(step)),
            source=rows,
        )
        return Decoded(gaussians, rows, None, {})

    def rate_groups(self) -> dict[str, list[nn.Parameter]]:
        """All parameters, grouped by the name of their learning rate: one group per column."""
        return {name: [self.table.params[name]] for name in COLUMNS}

    def meta(self) -> dict[str, Any]:
        return {"extent": self.extent}


@register
@dataclass(frozen=True)
class ExplicitRates(LearningRates):
    """Learning rates of 3DGS. The rate of `means` is multiplied by the scene's extent R."""

    family = "gaussians"

    means: Rate = Rate(0.00016, 0.0000016)
    """Learning rate of the positions, times the scene's extent."""
    log_scales: Rate = Rate(0.005, 0.005)
    """Learning rate of the sizes."""
    quats: Rate = Rate(0.001, 0.001)
    """Learning rate of the rotations."""
    raw_opacity: Rate = Rate(0.05, 0.05)
    """Learning rate of the opacities."""
    sh_dc: Rate = Rate(0.0025, 0.0025)
    """Learning rate of the base colours."""
    sh_rest: Rate = Rate(0.000125, 0.000125)
    """Learning rate of the higher spherical harmonics."""

    def at(self, group: str, step: int, total: int, extent: float) -> float:
        """Learning rate of `group`, a key of `rate_groups`, at `step` of `total`."""
        rate: Rate = getattr(self, group)
        return rate.at(step, total) * (extent if group == "means" else 1.0)
