"""Standard Gaussians as files hold them: the one structure between what makes them (a scene, a bake) and the writers and readers of files.

Values are those of 3DGS's PLY: logarithms of scales, logits of opacities, harmonics by coefficient and channel, in the capture's own frame
(x right, y down, z forward where the capture has OpenCV's axes). Writers of formats with other frames or units convert on their own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.data.views import World
from scene_experts.scene.gaussians import GaussianScene


@dataclass(frozen=True)
class Splats:
    """N Gaussians of one file, float32 on the CPU. Raises InputError where shapes disagree."""

    means: Tensor  # [N, 3]
    log_scales: Tensor  # [N, 3], natural logarithms of standard deviations
    quats: Tensor  # [N, 4] w, x, y, z; of any length above 0
    opacity_logit: Tensor  # [N]
    sh: Tensor  # [N, (degree + 1)^2, 3], coefficient before channel; colour = 0.5 + sum of coefficient * basis

    def __post_init__(self) -> None:
        n, c = len(self.means), self.sh.shape[1] if self.sh.dim() == 3 else 0
        want = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logit": (n,), "sh": (n, c, 3)}
        found = {name: tuple(getattr(self, name).shape) for name in want}
        if found != want or c not in (1, 4, 9, 16):
            raise InputError(f"expected one row of every attribute per Gaussian and 1, 4, 9 or 16 harmonics, found {found}; write it again")

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    def rows(self, index: Tensor) -> Splats:
        """The Gaussians at `index` (int64 [M] or bool [N]), in that order."""
        return Splats(self.means[index], self.log_scales[index], self.quats[index], self.opacity_logit[index], self.sh[index])


def from_scene(scene: GaussianScene, world: World) -> Splats:
    """A scene of explicit Gaussians in the capture's own frame: lengths scale and positions move, the axes stay."""
    p = {name: value.detach().cpu() for name, value in scene.table.params.items()}
    return Splats(
        means=world.to_input(p["means"].double()).float(),
        log_scales=(p["log_scales"].double() - math.log(world.scale)).float(),
        quats=p["quats"].float(),
        opacity_logit=p["raw_opacity"].float(),
        sh=torch.cat([p["sh_dc"][:, None], p["sh_rest"]], dim=1).float(),
    )


def to_columns(splats: Splats, world: World) -> dict[str, Tensor]:
    """The columns of a table of explicit Gaussians (`scene.explicit.COLUMNS`), in the trained world."""
    return {
        "means": world.from_input(splats.means.double()).float(),
        "log_scales": (splats.log_scales.double() + math.log(world.scale)).float(),
        "quats": splats.quats,
        "raw_opacity": splats.opacity_logit,
        "sh_dc": splats.sh[:, 0].contiguous(),
        "sh_rest": splats.sh[:, 1:].contiguous(),
    }
