"""Test Gaussians, and the largest rounding error of each format, computed from its bit widths."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.files.formats.pack import morton_order
from scene_experts.files.formats.splats import Splats
from scene_experts.geometry.sh import C0


def scene(n: int = 700, degree: int = 3, seed: int = 0, size: float = 3.0) -> Splats:
    """Gaussians with values like those of a trained scene."""
    g = torch.Generator().manual_seed(seed)
    new = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    sh = torch.cat([new(n, 1, 3), 0.15 * new(n, (degree + 1) ** 2 - 1, 3)], 1)
    return Splats(new(n, 3) * size, new(n, 3) * 0.8 - 4 + math.log(size), new(n, 4) + 1e-3, 2 * new(n), sh)


def in_file_order(format: str, s: Splats) -> Splats:
    """The rows as the format's writer sorts them."""
    if format in ("compressed-ply", "spz", "sog", "baked-html"):
        return s.rows(morton_order(s.means))
    if format == "splat":
        size = s.log_scales.double().sum(1) + s.opacity_logit.double().sigmoid().clamp_min(1e-30).log()
        return s.rows(torch.argsort(-size, stable=True))
    return s


def differences(found: Splats, wanted: Splats) -> dict[str, Tensor]:
    """Return |found - wanted| of every attribute. Opacities are compared after the sigmoid, unit quaternions up to their sign."""
    q, p = (functional.normalize(x.quats.double(), dim=1) for x in (found, wanted))
    return {
        "means": (found.means.double() - wanted.means.double()).abs(),
        "log_scales": (found.log_scales.double() - wanted.log_scales.double()).abs(),
        "opacity": (found.opacity_logit.double().sigmoid() - wanted.opacity_logit.double().sigmoid()).abs(),
        "quats": torch.minimum((q - p).norm(dim=1), (q + p).norm(dim=1)),
        "sh": (found.sh.double() - wanted.sh.double()).abs(),
    }


def quanta(format: str, s: Splats) -> dict[str, Tensor | float]:
    """Return the largest rounding error of the format, for rows in the order of the file. `sh` covers the harmonics in the file."""
    float32 = {"means": 0.0, "log_scales": 2e-5, "opacity": 1e-6, "quats": 1e-6, "sh": 0.0}
    if format in ("ply", "glb", "usd"):
        return float32
    return {"splat": _splat, "compressed-ply": _compressed, "spz": _spz, "baked-html": _spz, "sog": _sog}[format](s)


def _smallest_three(step: float) -> float:
    """Return the largest error of a unit quaternion whose three smallest components are rounded to multiples of `step`.

    The worst case has four components of 1/2: every rounding error changes the computed component in the same direction.
    """
    half = 0.51 * step
    computed = math.sqrt(1 - 3 * (0.5 + half) ** 2)
    return math.sqrt(3 * half**2 + (0.5 - computed) ** 2)


def _splat(s: Splats) -> dict[str, Tensor | float]:
    # readers differ by half a step in how they decode the bytes of a quaternion
    dc = s.sh[:, :1].double()
    beyond = (dc.abs() - 0.5 / C0).clamp_min(0)  # colours are cut to 0 .. 1
    return {"means": 0.0, "log_scales": 2e-5, "opacity": 0.51 / 255, "quats": 2 * 1.02 / 127, "sh": 0.51 / 255 / C0 + beyond}


def _ranges(x: Tensor) -> Tensor:
    """max - min of each chunk of 256 rows, for every row."""
    return torch.cat([(c.amax(0) - c.amin(0)).expand_as(c) for c in x.double().split(256)]) if len(x) else x.double()


def _compressed(s: Splats) -> dict[str, Tensor | float]:
    steps = torch.tensor([2047.0, 1023.0, 2047.0], dtype=torch.float64)
    rest = 0.51 * 8 / 256 + (s.sh[:, 1:].double().abs() - 4 + 4 / 256).clamp_min(0)
    colour = 0.51 * _ranges(s.sh[:, 0] * C0) / 255 / C0 + 1e-6
    return {
        "means": 0.51 * _ranges(s.means) / steps + 1e-6 * s.means.abs().double(),
        "log_scales": 0.51 * _ranges(s.log_scales.clamp(-20, 20)) / steps + 1e-5 + (s.log_scales.abs() - 20).clamp_min(0),
        "opacity": 0.51 / 255,
        "quats": _smallest_three(math.sqrt(2) / 1023),
        "sh": torch.cat([colour[:, None], rest], 1),
    }


def _spz(s: Splats) -> dict[str, Tensor | float]:
    bits = max(0, min(20, 22 - math.floor(math.log2(max(float(s.means.abs().max()) if len(s) else 1, 1e-9)))))
    half = 0.51 / 128
    rest = half + (s.sh[:, 1:].double().abs() - 1 + 1 / 128).clamp_min(0)
    dc = s.sh[:, :1].double()
    return {
        "means": 0.51 / 2**bits + 1e-7 * s.means.abs().double(),
        "log_scales": 0.51 / 16 + (-10 - s.log_scales).clamp_min(0) + (s.log_scales - 5.93).clamp_min(0),
        "opacity": 0.51 / 255,
        "quats": _smallest_three(math.sqrt(0.5) / 511),
        "sh": torch.cat([0.51 / 255 / 0.15 + (dc.abs() - 0.5 / 0.15).clamp_min(0), rest], 1),
    }


def _gap(x: Tensor) -> Tensor:
    """An upper bound of the distance to a codebook of 256 levels: the 128 even steps it starts from, which only come closer on average."""
    return torch.full_like(x.double(), float((x.amax() - x.amin()) / 24 + 1e-5) if x.numel() else 0.0)


def _sog(s: Splats) -> dict[str, Tensor | float]:
    place = s.means.double().sign() * s.means.double().abs().log1p()
    step = 0.51 * (place.amax(0) - place.amin(0)) / 65535
    wide = 6 * s.sh[:, 1:].double().abs().amax() if s.degree and len(s) else 0.0  # a palette has no quantum
    return {
        "means": (1 + s.means.double().abs()) * step * 1.01 + 1e-6,
        "log_scales": _gap(s.log_scales),
        "opacity": 0.51 / 255,
        "quats": _smallest_three(math.sqrt(2) / 255),
        "sh": torch.cat([_gap(s.sh[:, :1]), torch.full_like(s.sh[:, 1:].double(), float(wide))], 1),
    }


def check(format: str, found: Splats, original: Splats) -> None:
    """Every attribute of what was read is within the format's quantum of what was written."""
    wanted = in_file_order(format, original)
    if format == "splat":
        wanted = Splats(wanted.means, wanted.log_scales, wanted.quats, wanted.opacity_logit, wanted.sh[:, :1])
    assert len(found) == len(wanted) and found.sh.shape == wanted.sh.shape
    limits = quanta(format, wanted)
    for name, difference in differences(found, wanted).items():
        over = difference - limits[name]
        assert not len(found) or float(over.max()) <= 0, (format, name, float(over.max()), float(difference.max()))
