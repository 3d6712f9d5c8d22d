"""`Splats`: standard Gaussians as files hold them, between the scenes and bakes that make them and
the formats that store them.

Values are those of 3DGS's PLY: logarithms of scales, logits of opacities, and harmonics by
coefficient and channel, in the capture's own frame (x right, y down, z forward for captures with
OpenCV axes). A format with another frame or unit converts in its own module.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.reading.numbers import FARTHEST, LARGEST, LARGEST_LOG, all_finite, expect_range

log: logging.Logger = logging.getLogger(__name__)
NAMES = ("means", "log_scales", "quats", "opacity_logit", "sh")

_SURE = 20.0  # logit of an opacity of 1: 1 - 2e-9
_SHORTEST = math.log(1e-30)
MOST_DEGREE = 3
BROKEN = 100  # a file with more than one Gaussian in so many that is not finite is damaged
_NO_LENGTH = 1e-12  # of a quaternion; renderers divide by its length, or by this if that is less


def tell_degree(degree: int) -> None:
    """Warn of harmonics of a file that are not read."""
    if degree > MOST_DEGREE:
        log.warning("the file has harmonics up to degree %d: those above degree %d are left out", degree, MOST_DEGREE)


@dataclass(frozen=True)
class Splats:
    """N Gaussians of one file, float32 on the CPU; positions may be float64. Raises InputError for
    shapes that disagree."""

    means: Tensor  # [N, 3]; float64 where the file holds doubles
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

    @classmethod
    def joined(cls, parts: Sequence[Splats]) -> Splats:
        """All Gaussians of one or more parts, with the harmonics that every part has."""
        if len(parts) == 1:
            return parts[0]
        if len({part.degree for part in parts}) > 1:
            log.warning("parts have harmonics of different degrees: those above degree %d are left out", min(p.degree for p in parts))
        cut = [part.up_to_degree(min(p.degree for p in parts)) for part in parts]
        return cls(*(torch.cat([getattr(part, name) for part in cut]) for name in NAMES))

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

    def usable(self, where: Path) -> Splats:
        """The Gaussians of the file `where` with usable values for infinite ones, and for the
        largest floats, that mean something: an opacity of 1 or 0 has the logit 20 or -20, and a
        length of 0 the logarithm of 1e-30. Gaussians whose quaternion has no length are left out,
        and those with other values that are not finite if they are at most one in BROKEN; a warning
        counts them.

        Raises InputError where none is left.
        """
        found = self
        if bool((endless := self.opacity_logit.abs() > LARGEST).any()):
            found = replace(found, opacity_logit=self.opacity_logit.clamp(-_SURE, _SURE).where(endless, self.opacity_logit))
        if bool((points := self.log_scales < -LARGEST).any()):
            found = replace(found, log_scales=self.log_scales.masked_fill(points, _SHORTEST))
        found = found._without_broken(where)
        empty = found.quats.abs().amax(1) < _NO_LENGTH if len(found) else found.quats.new_zeros(0, dtype=torch.bool)  # False for NaN
        count = int(empty.sum())
        if not count:
            return found
        if count == len(found):
            raise InputError(f"expected Gaussians with rotations in {where}, found {count:,} without any (all zero); write the file again")
        log.warning("left out %s of %s Gaussians of %s, whose rotations are all zero", f"{count:,}", f"{len(found):,}", where)
        return found.rows(~empty)

    def _without_broken(self, where: Path) -> Splats:
        """Leave out the few Gaussians with values that are not finite, which a training that
        diverged in places leaves behind."""
        if all(all_finite(getattr(self, name)) for name in NAMES):
            return self
        broken = torch.stack([~getattr(self, name).isfinite().reshape(len(self), -1).all(1) for name in NAMES]).any(0)
        count = int(broken.sum())
        if count * BROKEN > len(self):
            return self
        log.warning("left out %s of %s Gaussians of %s, with values that are not finite", f"{count:,}", f"{len(self):,}", where)
        return self.rows(~broken)

    def expect_finite(self, where: str) -> None:
        """Raises InputError, naming `where`, for values that are not finite."""
        for name in NAMES:
            value = getattr(self, name)
            if not all_finite(value):
                bad = int((~value.isfinite()).reshape(len(value), -1).any(1).sum())
                kind = " or ".join(name for name, of in (("NaN", value.isnan()), ("infinite values", value.isinf())) if bool(of.any()))
                raise InputError(f"expected finite {name} in {where}, found {bad:,} Gaussians with {kind}; remove them or make it again")

    def checked(self, where: Path) -> Splats:
        """The Gaussians that are `usable`. Raises InputError, naming the file `where`, for values
        that are not finite, and Damaged for positions and scales that no computation in float32 can
        bear."""
        found = self.usable(where)
        found.expect_finite(str(where))
        expect_range(found.means, "positions", -FARTHEST, FARTHEST)
        expect_range(found.log_scales, "logarithms of scales", -LARGEST, LARGEST_LOG)
        for name in ("quats", "opacity_logit", "sh"):
            expect_range(getattr(found, name), f"values of {name}")
        return found
