"""Real spherical harmonics up to degree 3 in the layout of 3DGS: sh [..., (degree + 1)^2, 3], the
constant (DC) first."""

from __future__ import annotations

import torch
from torch import Tensor

C0 = 0.28209479177387814
C1 = 0.4886025119029199
C2 = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
MAX_DEGREE = 3


def basis(directions: Tensor, degree: int) -> Tensor:
    """Values [..., (degree + 1)^2] of the harmonics at unit directions [..., 3], in the order and
    with the signs of 3DGS files."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"expected a degree from 0 to {MAX_DEGREE}, found {degree}")
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    terms = [torch.full_like(x, C0)]
    if degree >= 1:
        terms += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        bands = (x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy)
        terms += [c * b for c, b in zip(C2, bands, strict=True)]
    if degree >= 3:
        bands = (
            y * (3 * xx - yy),
            x * y * z,
            y * (4 * zz - xx - yy),
            z * (2 * zz - 3 * xx - 3 * yy),
            x * (4 * zz - xx - yy),
            z * (xx - yy),
            x * (xx - 3 * yy),
        )
        terms += [c * b for c, b in zip(C3, bands, strict=True)]
    return torch.stack(terms, dim=-1)


def sh_to_rgb(sh: Tensor, directions: Tensor, degree: int) -> Tensor:
    """Colours max(0, sum + 0.5), [..., 3], along `directions` [..., 3] (Gaussian centre minus
    camera centre, of any length).

    `sh` [..., C, 3] may hold more coefficients than `degree` uses. The gradient is zero where the
    colour is clamped to 0.
    """
    count = (degree + 1) ** 2
    if sh.shape[-2] < count:
        raise ValueError(f"expected at least {count} coefficients per channel for degree {degree}, found {sh.shape[-2]}")
    unit = directions / directions.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    value = (basis(unit, degree)[..., None] * sh[..., :count, :]).sum(-2) + 0.5
    return value.clamp_min(0.0)


def rgb_to_dc(rgb: Tensor) -> Tensor:
    """The constant coefficient whose colour is `rgb` if all others are zero."""
    return (rgb - 0.5) / C0
