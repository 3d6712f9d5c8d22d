"""`Splats`: standard Gaussians as files hold them, between the scenes and bakes that make them and
the formats that store them.

Values are those of 3DGS's PLY: logarithms of scales, logits of opacities, and harmonics by
coefficient and channel, in the capture's own frame (x right, y down, z forward for captures with
OpenCV axes). A format with another frame or unit converts in its own module.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.reading.numbers import FARTHEST, LARGEST, LARGEST_LOG, all_finite, expect_range

NAMES = ("means", "log_scales", "quats", "opacity_logit", "sh")


@dataclass(frozen=True)
class Splats:
    """N Gaussians of one file, float32 on the CPU. Raises InputError for shapes that disagree."""

    means: Tensor  # [N, 3]
    log_scales: Tensor  # [N, 3], natural logarithms of standard deviations
    quats: Tensor  # [N, 4] w, x, y, z; any length above 0
    opacity_logit: Tensor  # [N]
    sh: Tensor  # [N, (degree + 1)^2, 3], coefficient before channel; colour = 0.5 + sum of coefficient * basis

    def __post_init__(self) -> None:
        n, c = len(self.means), self.sh.shape[1] if self.sh.dim() == 3 else 0
        want = {"means": (n, 3), "log_scales": (n, 3), "quats": (n, 4), "opacity_logit": (n,), "sh": (n, c, 3)}
        found = {name: tuple(getattr(self, name).shape) for name in want}
        if found != want or c not in (1, 4, 9, 16):
            raise InputError(
                f"expected one row of each attribute per Gaussian and 1, 4, 9 or 16 harmonics, found {found}; write the file again"
            )

    def __len__(self) -> int:
        return len(self.means)

    @property
    def degree(self) -> int:
        """Degree of the harmonics, 0 to 3."""
        return math.isqrt(self.sh.shape[1]) - 1

    def rows(self, index: Tensor) -> Splats:
        """The Gaussians at `index` (int64 [M] or bool [N]), in that order."""
        return Splats(self.means[index], self.log_scales[index], self.quats[index], self.opacity_logit[index], self.sh[index])

    def up_to_degree(self, degree: int) -> Splats:
        """The Gaussians without the harmonics above a degree."""
        return self if self.degree <= degree else replace(self, sh=self.sh[:, : (degree + 1) ** 2])

    def expect_finite(self, where: str) -> None:
        """Raises InputError, naming `where`, for values that are not finite."""
        for name in NAMES:
            value = getattr(self, name)
            if not all_finite(value):
                bad = int((~value.isfinite()).reshape(len(value), -1).any(1).sum())
                raise InputError(f"expected finite {name} in {where}, found {bad:,} Gaussians with others; make it again")

    def checked(self, where: Path) -> Splats:
        """These Gaussians. Raises InputError, naming the file `where`, for values that are not
        finite, and Damaged for positions and scales that no computation in float32 can bear."""
        self.expect_finite(str(where))
        expect_range(self.means, "positions", -FARTHEST, FARTHEST)
        expect_range(self.log_scales, "logarithms of scales", -LARGEST, LARGEST_LOG)
        for name in ("quats", "opacity_logit", "sh"):
            expect_range(getattr(self, name), f"values of {name}")
        return self
