"""The training loss: a sum of named terms. A new term needs one function and one entry in
`Weights.terms`.

Images are [H, W, 3] float RGB in [0, 1]. The mean over an empty set (no Gaussians, anchors or
pixels) is 0. Equation numbers refer to "Scene Experts" (MoE-GS, AAAI 2026). The photometric loss is
that of 3DGS.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.arguments.option import Option
from scene_experts.core.fields import SCALES, Needs, NotNegative, Share, With
from scene_experts.core.parts import Part, register
from scene_experts.core.types import Decoded, Render, Routing
from scene_experts.native import terms as native_terms
from scene_experts.scene import EXPLICIT, OPACITY, ROUTERS
from scene_experts.training.photometric import photometric
from scene_experts.training.robust import weigh_residuals


@dataclass(frozen=True)
class Sample:
    """Inputs of the loss in one iteration."""

    decoded: Decoded
    render: Render
    target: Tensor  # [H, W, 3], the photograph
    mask: Tensor | None = None  # [H, W] in [0, 1]; pixels with 0 are ignored
    step: int | None = None  # the iteration, for terms that start or end; None: all terms are active
    depth: Tensor | None = None  # [h, w] in world units, what is known of the view's depth; 0 where nothing is


SOLID = 0.9  # opacity above which a pixel has a depth
LARGEST_ERROR = 0.2  # relative, of a depth: a larger one is one of the map, or of something else that the map shows

Term = Callable[["Weights", Sample], dict[str, Tensor]]
"""Function that maps weights and a sample to weighted terms by name, each []. Empty if the term is
off or does not apply."""


@register
@dataclass(frozen=True)
class Weights(Part):
    """Weights of the loss terms, and settings for what the paper leaves open. A term of weight 0 is
    left out.

    A recipe with a term of its own subclasses this class, adds a field for the weight, and adds the
    function to `terms`.
    """

    terms: ClassVar[tuple[Term, ...]] = ()

    dssim: Share = 0.2
    """Weight of 1 - SSIM; L1 has the weight 1 - dssim."""
    scale: NotNegative = 0.01
    """Weight of the mean volume of the rendered Gaussians."""
    opacity: Annotated[NotNegative, Needs(OPACITY)] = 0.0
    """Weight of the opacity hinge (eq. 8)."""
    load: Annotated[NotNegative, Needs(ROUTERS)] = 0.0
    """Weight of the load balancing (eq. 6 and 7)."""
    tau: Annotated[float, With(("opacity",))] = 0.0
    """Opacity below which the hinge acts."""
    mean_opacity: Annotated[NotNegative, Needs(EXPLICIT)] = 0.0
    """Weight of the mean opacity of all explicit Gaussians (3DGS-MCMC)."""
    mean_size: Annotated[NotNegative, Needs(EXPLICIT)] = 0.0
    """Weight of the mean size of all explicit Gaussians over the three axes (3DGS-MCMC)."""
    depth: NotNegative = 0.0
    """Weight of the error of the drawn depth, for captures with depth maps. It falls to a tenth."""
    depth_until: Annotated[int, Option(hidden=True), SCALES] = 30_000
    """Iteration at which the weight of the depth has fallen to a tenth."""
    opacity_from: Annotated[int, SCALES, With(("opacity",))] = 0
    """First iteration with the opacity hinge."""
    opacity_until: Annotated[int | None, SCALES, With(("opacity",))] = None
    """Last iteration with the opacity hinge; none means the last iteration of the training."""
    residual_quantile: Share = 1.0
    """Share of each picture's pixels that count in full, those with the smallest residuals; 1 means
    all. Below 1, things that move between the photographs count less."""
    residual_weight: Annotated[Share, With(("residual_quantile",), off=1)] = 0.0
    """Weight of the pixels with larger residuals."""
    residual_from: Annotated[int, SCALES, With(("residual_quantile",), off=1)] = 1500
    """First iteration in which pixels with large residuals count less."""

    def has_hinge(self, step: int | None) -> bool:
        """Whether the opacity hinge is active at `step`. None ignores its window."""
        on = step is None or (step >= self.opacity_from and (self.opacity_until is None or step <= self.opacity_until))
        return self.opacity != 0 and on

    def weigh_pixels(self, image: Tensor, target: Tensor, mask: Tensor | None, step: int | None) -> Tensor | None:
        """Return the weights of the pixels in the photometric terms, [H, W]: `mask`, or less where
        residuals are large. None: all are 1."""
        if self.residual_quantile < 1 and (step is None or step >= self.residual_from):
            return weigh_residuals(image, target, self.residual_quantile, self.residual_weight, mask)
        return mask

    def weigh_depth(self, step: int | None) -> float:
        """Return the weight of the depth at `step`; None is the first."""
        return self.depth * 0.1 ** min(1.0, (step or 0) / max(self.depth_until, 1))

    @property
    def regularises(self) -> bool:
        """Whether a loss acts on all Gaussians of a scene of plain Gaussians, drawn or not."""
        return bool(self.mean_opacity or self.mean_size)

    def reaches_every_row(self, decoded: Decoded) -> bool:
        """Whether the loss has a gradient for rows of the table that the view did not decode."""
        return decoded.population is not None and self.regularises


def compute_terms(sample: Sample, weights: Weights) -> dict[str, Tensor]:
    """Compute the weighted loss terms by name, each []. The training minimises their sum."""
    out: dict[str, Tensor] = {}
    for term in weights.terms:
        out |= term(weights, sample)
    return out


def compute_scene_terms(decoded: Decoded, step: int | None, weights: Weights) -> dict[str, Tensor]:
    """Compute the terms that see the decoded scene only, not the picture."""
    out: dict[str, Tensor] = {}
    for term in SCENE_TERMS:
        out |= term(weights, Sample(decoded, None, None, None, step))  # type: ignore[arg-type]
    return out


# --- terms: weights and sample to {name: weighted value} ----------------------------------------------------------------------------------


def photometric_terms(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """L1 and 1 - SSIM. Their weights sum to 1."""
    mask = w.weigh_pixels(sample.render.image, sample.target, sample.mask, sample.step)
    l1, dssim = photometric(sample.render.image, sample.target, w.dssim, mask)
    return ({"l1": l1} if w.dssim != 1 else {}) | ({"dssim": dssim} if w.dssim != 0 else {})


def depth_term(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """The error of the drawn depth, where the capture knows it."""
    if w.depth == 0 or sample.depth is None:
        return {}
    return {"depth": w.weigh_depth(sample.step) * depth_error(sample.render.depth, sample.render.alpha, sample.depth, sample.mask)}


def volume_term(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """The mean volume of the rendered Gaussians (Scaffold-GS)."""
    return {"volume": w.scale * volume(sample.decoded.gaussians.scales)} if w.scale != 0 else {}


def hinge_term(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """The opacity hinge (eq. 8)."""
    if not w.has_hinge(sample.step) or sample.decoded.raw_opacity is None:
        return {}
    return {"opacity": w.opacity * opacity_hinge(sample.decoded.raw_opacity, w.tau)}


def mean_opacity_term(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """The mean opacity of all explicit Gaussians, visible or not (3DGS-MCMC)."""
    if w.mean_opacity == 0 or sample.decoded.population is None:
        return {}
    logits = sample.decoded.population[0]
    return {"mean_opacity": w.mean_opacity * (logits.sigmoid().sum() / max(logits.numel(), 1))}


def mean_size_term(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """The mean scale over all explicit Gaussians and axes, visible or not (3DGS-MCMC)."""
    if w.mean_size == 0 or sample.decoded.population is None:
        return {}
    log_scales = sample.decoded.population[1]
    return {"mean_size": w.mean_size * (log_scales.exp().sum() / max(log_scales.numel(), 1))}


def load_term(w: Weights, sample: Sample) -> dict[str, Tensor]:
    """The load-balancing loss of the experts (eq. 6, 7)."""
    return {"load": w.load * load(sample.decoded.routing)} if w.load != 0 and sample.decoded.routing else {}


SCENE_TERMS: tuple[Term, ...] = (volume_term, hinge_term, mean_opacity_term, mean_size_term, load_term)
Weights.terms = (photometric_terms, depth_term, *SCENE_TERMS)


# --- functions that the terms use ---------------------------------------------------------------------------------------------------------


def depth_error(drawn: Tensor, alpha: Tensor, known: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean over all pixels of the relative error of the depth, at most 0.2 each, [].

    A pixel counts where its depth is known, its mask is above 0.5 and the scene is nearly opaque;
    the others have no error. So a map that is wrong somewhere has little weight there, and the
    scene is not made opaque or transparent.

    Args:
        drawn: [H, W] depth of a `Render`, which is not divided by alpha.
        alpha: [H, W] opacity.
        known: [h, w] depth of the same view at any size, 0 where it is not known.
        mask: [H, W] in [0, 1] or None.
    """
    if known.shape != drawn.shape:
        known = functional.interpolate(known[None, None], size=drawn.shape, mode="nearest")[0, 0]
    alpha = alpha.detach()
    counts = (known > 0) & (alpha > SOLID)
    if mask is not None:
        counts &= mask > 0.5
    error = ((drawn / alpha.clamp_min(SOLID) - known).abs() / torch.where(counts, known, 1.0)).clamp(max=LARGEST_ERROR)
    return torch.where(counts, error, 0.0).sum() / counts.numel()


def volume(scales: Tensor) -> Tensor:
    """Mean of sx sy sz over the scales [M, 3], []: the volume regulariser of Scaffold-GS."""
    if native_terms.covers(scales):
        return native_terms.sum_volumes(scales) / max(len(scales), 1)
    x, y, z = scales.unbind(1)
    return (x * y * z).sum() / max(len(scales), 1)


def opacity_hinge(raw_opacity: Tensor, tau: float = 0.0) -> Tensor:
    """Mean of max(0, tau - sigma) over all K Gaussians of the decoded anchors, rendered or not (eq.
    8), []. raw_opacity is [A, K]."""
    if native_terms.covers(raw_opacity):
        return native_terms.sum_hinge(raw_opacity, tau) / max(raw_opacity.numel(), 1)
    return functional.relu(tau - raw_opacity).sum() / max(raw_opacity.numel(), 1)


def load_sparse(gates: Tensor, chosen: Tensor) -> Tensor:
    """E sum_i pi_i P_i (eq. 6), [].

    pi_i is the share of anchors that chose expert i (without gradient), and P_i is its mean gate.
    The loss is k for perfect balance and nearly E if the routing collapses to one expert.

    Args:
        gates: [A, E] gates of all experts.
        chosen: [A, k] int64 indices of the chosen experts.
    """
    A, E = gates.shape
    if chosen.device.type == "cpu":
        counts = torch.bincount(chosen.reshape(-1), minlength=E)
    else:  # bincount synchronises with the device
        counts = (chosen[..., None] == torch.arange(E, device=chosen.device)).sum((0, 1))
    share = counts.to(gates.dtype) / max(A, 1)
    return E * (share * _mean(gates)).sum()


def load_dense(gates: Tensor) -> Tensor:
    """E sum_i C_i^2 (eq. 7), []. C_i is the mean gate of expert i, and gates is [A, E]. 1 is
    perfect balance, E is full collapse."""
    return gates.shape[1] * _mean(gates).square().sum()


def load(routing: Mapping[str, Routing]) -> Tensor:
    """Load-balancing loss, []: the sum over the attributes with experts of eq. 7 while dense, of
    eq. 6 after it.

    `routing` must not be empty.
    """
    values = [load_dense(r.gates) if r.chosen is None else load_sparse(r.gates, r.chosen) for r in routing.values()]
    return torch.stack(values).sum()


def _mean(gates: Tensor) -> Tensor:
    """Mean over the anchors, [E]. It is 0 without anchors."""
    return gates.sum(0) / max(len(gates), 1)
