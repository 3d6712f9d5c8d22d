"""The objective: photometric loss, scale volume, opacity hinge and the load balance of the experts, as a named sum.

Pictures are [H, W, 3] float RGB in [0, 1]. The mean of nothing (no Gaussian, no anchor, no pixel that counts) is 0.
Equation numbers are those of "Scene Experts" (MoE-GS, AAAI 2026); the photometric part is 3DGS's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Literal

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.types import Decoded, Render, Routing
from scene_experts.native import library as native
from scene_experts.native import terms as native_terms

TAPS, SIGMA, C1, C2 = 11, 1.5, 0.01**2, 0.03**2


@dataclass(frozen=True)
class Weights:
    """Weights of the objective's terms and the switches for what the paper leaves open. A term of weight 0 is left out."""

    dssim: float = 0.2
    """Weight of 1 - SSIM; L1 gets the rest of 1."""
    scale: float = 0.01
    """Weight of the mean volume of the drawn Gaussians."""
    opacity: float = 0.0
    """Weight of the opacity hinge (eq. 8)."""
    load: float = 0.0
    """Weight of the load balance (eq. 6, 7)."""
    tau: float = 0.0
    """Opacity below which the hinge pulls."""
    opacity_scope: Literal["visible", "rendered_anchors", "all"] = "visible"
    """Whose opacities the hinge sees: all K of every visible anchor, of anchors with a drawn Gaussian, or of every anchor of the scene."""
    load_reduce: Literal["sum", "mean"] = "sum"
    """Over the attributes that have experts."""
    load_phase: Literal["exclusive", "both"] = "exclusive"
    """exclusive: eq. 7 while dense, eq. 6 after; both: their sum after."""
    load_normalise_by_k: bool = False
    """Divide eq. 6 by k, so that perfect balance is 1 for every k."""
    mean_opacity: float = 0.0
    """Weight of the mean opacity over all explicit Gaussians (3DGS-MCMC)."""
    mean_size: float = 0.0
    """Weight of the mean scale over all explicit Gaussians and axes (3DGS-MCMC)."""
    opacity_from: int = 0
    """First iteration with the opacity hinge."""
    opacity_until: int | None = None
    """Last iteration with the opacity hinge; None: it never ends."""

    def check(self) -> None:
        """Raises InputError for weights that no training can have: below 0, or a share of 1 - SSIM beyond 1."""
        names = ("dssim", "scale", "opacity", "load", "mean_opacity", "mean_size")
        expect_at_least([(f"--loss.{name.replace('_', '-')}", getattr(self, name), 0) for name in names])
        if self.dssim > 1:
            raise InputError(f"expected --loss.dssim of at most 1, found {self.dssim}; L1 gets the rest of 1, so give a smaller number")


def terms(
    decoded: Decoded, render: Render, target: Tensor, w: Weights, step: int | None = None, mask: Tensor | None = None
) -> dict[str, Tensor]:
    """The weighted terms of the objective by name, each []; their sum is what training minimises.

    target [H, W, 3]; mask [H, W] in [0, 1], 1 = counts; step: the iteration, for terms that start or end (None: all are on).
    """
    l1_term, dssim_term = photometric(render.image, target, w.dssim, mask)
    out = {}
    if w.dssim != 1:
        out["l1"] = l1_term
    if w.dssim != 0:
        out["dssim"] = dssim_term
    if w.scale != 0:
        out["volume"] = w.scale * volume(decoded.gaussians.scales)
    if hinge_is_on(w, step) and decoded.raw_opacity is not None:
        out["opacity"] = w.opacity * opacity_hinge(hinge_opacities(decoded, render, w), w.tau)
    if decoded.population is not None:
        logits, log_scales = decoded.population
        if w.mean_opacity != 0:
            out["mean_opacity"] = w.mean_opacity * (logits.sigmoid().sum() / max(logits.numel(), 1))
        if w.mean_size != 0:
            out["mean_size"] = w.mean_size * (log_scales.exp().sum() / max(log_scales.numel(), 1))
    if w.load != 0 and decoded.routing:
        out["load"] = w.load * load(decoded.routing, w)
    return out


def l1(image: Tensor, target: Tensor) -> Tensor:
    """Mean absolute difference over pixels and channels, []."""
    return (image - target).abs().sum() / max(image.numel(), 1)


def ssim(image: Tensor, target: Tensor) -> Tensor:
    """Structural similarity, [], 1 for equal pictures.

    11 x 11 Gaussian window of sigma 1.5, zero padding, per channel, biased variances, mean over pixels and channels (Wang et al. 2004 with
    the padding of 3DGS). image, target [H, W, 3] of any size, device and floating dtype; differentiable in both.
    """
    return 1 - dissimilarity(image, target)


def dissimilarity(image: Tensor, target: Tensor) -> Tensor:
    """1 - SSIM, [], written so that float32 loses nothing of it where the pictures agree.

    With the sum s and the difference d of the pictures: S = (1 - p)(1 - q), p = E[d]^2 / (mx^2 + my^2 + C1) and
    q = var(d) / (var(x) + var(y) + C2), where mx^2 + my^2 = (E[s]^2 + E[d]^2) / 2 and the same for the variances.
    """
    s, d = (image + target - 1).movedim(2, 0), (image - target).movedim(2, 0)  # [3, H, W]
    # The sum minus 1 (and its padding with it) has the same variance, from smaller squares.
    s, d = functional.pad(s, [TAPS // 2] * 4, value=-1.0), functional.pad(d, [TAPS // 2] * 4)
    window = _window(s.dtype, s.device)
    maps = torch.cat([s, d, s * s, d * d])[None]
    maps = functional.conv2d(functional.conv2d(maps, window[:, :, None], groups=12), window[..., None], groups=12)
    ms, md, ss, dd = maps[0].chunk(4)  # each [3, H, W]
    vd = dd - md * md
    p = md * md / (((ms + 1).square() + md * md) / 2 + C1)
    q = vd / ((ss - ms * ms + vd) / 2 + C2)
    return (p + q - p * q).sum() / max(p.numel(), 1)


@cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    """The window's one-dimensional factor for each of 12 maps, shaped [12, 1, TAPS]."""
    t = torch.arange(TAPS, dtype=torch.float64) - TAPS // 2
    w = torch.exp(-t * t / (2 * SIGMA * SIGMA))
    return (w / w.sum()).to(device, dtype).repeat(12, 1, 1)


def photometric(image: Tensor, target: Tensor, lambda_dssim: float, mask: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """((1 - lambda) L1, lambda (1 - SSIM)), both []: 3DGS's photometric loss as two terms.

    image, target [H, W, 3]. With mask [H, W] (1 = counts), the render is replaced by the target where nothing counts and both terms are
    divided by the share that counts. float32 on the CPU is one call of the compiled library for values and gradient; anything else, and
    a target that needs a gradient, is plain torch.
    """
    if mask is not None:
        image = torch.lerp(target, image, mask.to(image.dtype)[..., None])
    fused = image.device.type == "cpu" and image.dtype == target.dtype == torch.float32 and not target.requires_grad and image.numel() > 0
    if fused and native.load() is not None:
        both = _Photometric.apply(image, target, float(lambda_dssim))
    else:
        both = ((1 - lambda_dssim) * l1(image, target), lambda_dssim * dissimilarity(image, target))
    if mask is None:
        return both
    share = mask.to(image.dtype).mean().clamp_min(1e-12)
    return both[0] / share, both[1] / share


class _Photometric(torch.autograd.Function):
    """Both terms and the gradient of their sum in one pass over the picture; the backward pass only scales it."""

    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, lambda_dssim: float) -> tuple[Tensor, Tensor]:
        x, y = image.detach().contiguous(), target.detach().contiguous()
        gradient = torch.empty_like(x) if ctx.needs_input_grad[0] else None
        found = torch.empty(2, dtype=torch.float64)
        H, W, _ = x.shape
        tensors = [native.pointer(t) for t in (x, y, gradient, found)]
        code = native.require().se_photometric_loss(
            *tensors[:2], H, W, 1 - lambda_dssim, lambda_dssim, native.count_threads(), *tensors[2:]
        )
        native.check(code, "the photometric loss")
        ctx.l1_weight = 1 - lambda_dssim
        if gradient is not None:
            ctx.save_for_backward(x, y, gradient)
        return ((1 - lambda_dssim) * found[0]).float(), (lambda_dssim * found[1]).float()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor, None, None]:
        x, y, gradient = ctx.saved_tensors
        by_l1, by_dssim = (float(g) for g in upstream)
        out = gradient if by_dssim == 1 else gradient * by_dssim
        if by_l1 != by_dssim:  # the stored sum holds both terms in equal parts; L1's share is cheap to make again
            out = torch.add(out, (x - y).sign_(), alpha=(by_l1 - by_dssim) * ctx.l1_weight / x.numel())
        return out, None, None


def hinge_is_on(w: Weights, step: int | None) -> bool:
    """Whether the opacity hinge acts at `step` (None: its window is ignored)."""
    return w.opacity != 0 and (step is None or (step >= w.opacity_from and (w.opacity_until is None or step <= w.opacity_until)))


def hinge_opacities(decoded: Decoded, render: Render, w: Weights) -> Tensor:
    """The raw opacities [.., K] that the hinge sees under `w.opacity_scope`. "all" expects them in `decoded.scene_opacity`."""
    assert decoded.raw_opacity is not None
    if w.opacity_scope == "visible":
        return decoded.raw_opacity
    if w.opacity_scope == "all":
        if decoded.scene_opacity is None:
            raise ValueError("expected decoded.scene_opacity for the hinge over all anchors, found none")
        return decoded.scene_opacity
    K = decoded.raw_opacity.shape[1]
    drawn = torch.div(decoded.gaussians.source[render.radii > 0], K, rounding_mode="floor")
    return decoded.raw_opacity[torch.isin(decoded.rows, drawn)]


def volume(scales: Tensor) -> Tensor:
    """Mean of sx sy sz over Gaussians [M, 3], []: Scaffold-GS's volume regulariser."""
    if native_terms.covers(scales):
        return native_terms.sum_volumes(scales) / max(len(scales), 1)
    x, y, z = scales.unbind(1)
    return (x * y * z).sum() / max(len(scales), 1)


def opacity_hinge(raw_opacity: Tensor, tau: float = 0.0) -> Tensor:
    """Mean of max(0, tau - sigma) over all K Gaussians of the decoded anchors, drawn or not (eq. 8); raw_opacity [A, K]."""
    if native_terms.covers(raw_opacity):
        return native_terms.sum_hinge(raw_opacity, tau) / max(raw_opacity.numel(), 1)
    return functional.relu(tau - raw_opacity).sum() / max(raw_opacity.numel(), 1)


def load_sparse(gates: Tensor, chosen: Tensor) -> Tensor:
    """E sum_i pi_i P_i (eq. 6), []: pi_i the share of anchors that chose expert i (no gradient), P_i the mean gate.

    gates [A, E], chosen [A, k]. Perfect balance is k, collapse on one expert nearly E.
    """
    A, E = gates.shape
    if chosen.device.type == "cpu":
        counts = torch.bincount(chosen.reshape(-1), minlength=E)
    else:  # where bincount makes the host wait
        counts = (chosen[..., None] == torch.arange(E, device=chosen.device)).sum((0, 1))
    share = counts.to(gates.dtype) / max(A, 1)
    return E * (share * _mean(gates)).sum()


def load_dense(gates: Tensor) -> Tensor:
    """E sum_i C_i^2 (eq. 7), [], with C_i the mean gate; gates [A, E]. Perfect balance is 1, collapse on one expert E."""
    return gates.shape[1] * _mean(gates).square().sum()


def load(routing: dict[str, Routing], w: Weights) -> Tensor:
    """The load balance over all attributes with experts, each in the phase it is in; routing must not be empty."""
    values = []
    for r in routing.values():
        if r.chosen is None:
            values.append(load_dense(r.gates))
            continue
        value = load_sparse(r.gates, r.chosen)
        if w.load_normalise_by_k:
            value = value / r.chosen.shape[1]
        values.append(value + load_dense(r.gates) if w.load_phase == "both" else value)
    total = torch.stack(values).sum()
    return total / len(values) if w.load_reduce == "mean" else total


def _mean(gates: Tensor) -> Tensor:
    """Mean over anchors, [E]; 0 without anchors."""
    return gates.sum(0) / max(len(gates), 1)
