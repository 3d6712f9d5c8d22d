"""A recipe of another package: MoE-GS with a loss term that draws opacities towards 0 and 1.

pip install --editable examples/new_loss
scene-experts train binary-opacity --data CAPTURE --out RUN --loss.binary 0.02
"""

from dataclasses import dataclass, replace

from torch import Tensor

import scene_experts as se
from scene_experts.core.fields import NotNegative
from scene_experts.core.parts import extend, register
from scene_experts.training.losses import Sample, Weights


@register
@dataclass(frozen=True)
class BinaryOpacity(Weights):
    binary: NotNegative = 0.0
    """Weight of the mean of 4 o (1 - o) over the opacities o of the Gaussians: 0 where each is 0 or 1, 1 where all are 0.5."""


def binary_term(weights: BinaryOpacity, sample: Sample) -> dict[str, Tensor]:
    """Return the weighted term by its name, or nothing if it is off."""
    if weights.binary == 0:
        return {}
    o = sample.decoded.gaussians.opacities  # [M], in (0, 1]
    return {"binary": weights.binary * (4 * o * (1 - o)).sum() / max(len(o), 1)}  # a view may see no Gaussian


BinaryOpacity.terms = (*Weights.terms, binary_term)  # type: ignore[assignment]

BASE = se.recipe("moe-gs")
RECIPE = "MoE-GS whose opacities are near 0 or 1", replace(BASE, loss=extend(BASE.loss, BinaryOpacity, binary=0.01))
