"""Rasterisers behind one protocol, and the choice among them.

`reference` (plain torch, slow) defines the picture; `cpu` (compiled) and `gsplat` (CUDA) draw the
same one fast.
"""

from __future__ import annotations

import functools
import warnings
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.gradients import BackwardPicture, GaussianGradients
from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.native import library as native

NAMES = ("auto", "reference", "cpu", "gsplat")


class Rasterizer(Protocol):
    """Draws Gaussians; every backend gives the picture, depth, radii and gradients that
    `types.Render` describes."""

    @property
    def name(self) -> str:
        """One of NAMES without `auto`."""
        ...

    def __call__(self, g: Gaussians, camera: Camera, background: Tensor) -> Render:
        """Draws M Gaussians over `background` [3]; a later backward pass overwrites the picture's
        `mean2d_grad`."""
        ...

    def visible(self, means: Tensor, scales: Tensor, camera: Camera) -> Tensor:
        """Whether unrotated Gaussians at `means` [A, 3] with `scales` [A, 3] would be drawn (3
        sigma radius > 0), [A] bool."""
        ...


def choose(name: str, device: torch.device | str, antialias: bool = False, deterministic: bool = False) -> Rasterizer:
    """The rasteriser called `name` for tensors on `device`.

    `auto`: gsplat on CUDA; on the CPU the compiled rasteriser if it loads, otherwise the reference
    with one warning. On CUDA without gsplat `auto` raises InputError: the reference is hundreds of
    times slower there. `antialias` multiplies opacities by the share of the 2D Gaussian's area that
    the 0.3 px blur left (Mip-Splatting's compensation). `deterministic`: bit-identical gradients
    from run to run, where the backend can. Raises InputError for what cannot be had.
    """
    device = torch.device(device)
    if name == "auto":
        name = _best(device)
    if name == "cpu":
        from scene_experts.render.cpu import CpuRasterizer

        if device.type != "cpu":
            raise InputError(f"the rasteriser `cpu` draws tensors on the CPU, not on {device}: choose `gsplat` or `reference`")
        return CpuRasterizer(antialias=antialias, deterministic=deterministic)
    if name == "gsplat":
        from scene_experts.render.gsplat import GsplatRasterizer

        if device.type != "cuda":
            raise InputError(f"the rasteriser `gsplat` draws tensors on CUDA, not on {device}: choose `cpu` or `reference`")
        if deterministic:
            warnings.warn("gsplat adds up gradients in no fixed order: only --device cpu gives bit-identical results", stacklevel=2)
        return GsplatRasterizer(antialias=antialias)
    if name == "reference":
        from scene_experts.render.reference import ReferenceRasterizer

        return ReferenceRasterizer(antialias=antialias)
    raise InputError(f"there is no rasteriser `{name}`: choose one of {', '.join(NAMES)}")


def as_trained(rasterize: Rasterizer, antialias: bool) -> Rasterizer:
    """Return the rasteriser with the antialiasing that a run was trained with, if it supports
    it."""
    if getattr(rasterize, "antialias", antialias) != antialias:
        return replace(rasterize, antialias=antialias)  # type: ignore[type-var]
    return rasterize


def for_training(rasterize: Rasterizer, absolute: bool, depth: bool = False) -> Rasterizer:
    """Return the rasteriser as a training uses it: without the depth where it can leave it out and the
    loss does not see it (`depth`), and with sums of absolute values in `mean2d_grad` if `absolute`.
    Raises InputError if it has none."""
    if hasattr(rasterize, "depth"):
        rasterize = replace(rasterize, depth=depth)  # type: ignore[type-var]
    if not absolute:
        return rasterize
    if not hasattr(rasterize, "absolute"):
        raise InputError(f"the rasteriser `{rasterize.name}` has no absolute gradients: use --growth.gradient signed")
    return replace(rasterize, absolute=True)  # type: ignore[type-var]


def explain_indirect(rasterize: Rasterizer) -> str | None:
    """Return None if the rasteriser can go backward by itself, else the reason why autograd
    has to."""
    explain = getattr(rasterize, "explain_indirect", None)
    return explain() if explain is not None else f"the rasteriser `{rasterize.name}`"


def draw_with_gradients(rasterize: Rasterizer, g: Gaussians, camera: Camera, background: Tensor) -> tuple[Render, BackwardPicture]:
    """Draw Gaussians without a graph. Returns the picture with the function that takes the gradients of
    the picture, and returns those of the Gaussians and fills the picture's `mean2d_grad`.

    A rasteriser that cannot go backward by itself goes through autograd.
    """
    direct = getattr(rasterize, "draw_with_gradients", None)
    if direct is not None and len(g) and explain_indirect(rasterize) is None:
        return direct(g, camera, background)
    with torch.enable_grad():
        leaves = {name: getattr(g, name).detach().requires_grad_() for name in ("means", "quats", "scales", "opacities", "colors")}
        made = rasterize(replace(g, **leaves), camera, background)

    def backward(d_picture: Tensor) -> GaussianGradients:
        found = torch.autograd.grad(made.image, list(leaves.values()), d_picture, allow_unused=True)
        return GaussianGradients(*(torch.zeros_like(t) if f is None else f.contiguous() for t, f in zip(leaves.values(), found)))

    return replace(made, image=made.image.detach(), alpha=made.alpha.detach(), depth=made.depth.detach()), backward


def _best(device: torch.device) -> str:
    if device.type == "cuda":
        from scene_experts.render.gsplat_install import explain_missing

        reason = explain_missing()
        if reason is not None:
            raise InputError(reason)
        return "gsplat"
    if device.type != "cpu":
        _warn(f"no other one draws tensors on {device}")
    elif native.load() is not None:
        return "cpu"
    else:
        _warn(native.explain_missing() or "the compiled CPU library cannot be used")
    return "reference"


@functools.cache
def _warn(reason: str) -> None:
    warnings.warn(f"the slow reference rasteriser is in use, some hundred times slower than the fast ones: {reason}", stacklevel=4)
