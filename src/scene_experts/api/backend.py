"""The choice of device and rasteriser, for commands and for the Python API."""

from __future__ import annotations

import functools
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

import torch

from scene_experts.core.choices import Device, Raster
from scene_experts.core.errors import InputError
from scene_experts.render import Rasterizer, choose
from scene_experts.render.gsplat_install import explain_missing


def backend(device: Device, raster: Raster, antialias: bool, deterministic: bool) -> tuple[str, Rasterizer]:
    """The device and the rasteriser for it. Raises InputError for one that this machine does not
    have.

    deterministic: also make torch use its deterministic algorithms from now on, in the whole
    process.
    """
    device = device_of(device, raster)
    if deterministic:
        torch.use_deterministic_algorithms(True, warn_only=True)
    return device, choose(raster, device, antialias=antialias, deterministic=deterministic)


def device_of(device: str, raster: Raster = "auto") -> Literal["cpu", "cuda"]:
    """Return "cpu" or "cuda".

    "auto" is CUDA if torch finds a device and the rasteriser `raster` draws on it. If only gsplat
    is missing for the rasteriser "auto", the CPU is used, and one warning says what to install.
    Raises InputError for another name, and for "cuda" without CUDA.
    """
    available = torch.cuda.is_available()
    if device == "cuda" and not available:
        raise InputError("expected a CUDA device, found none that torch can use; run `scene-experts doctor`, or use --device cpu")
    if device == "cpu":
        return "cpu"
    if device == "cuda":
        return "cuda"
    if device == "auto":
        return "cuda" if available and _draws_on_cuda(raster) else "cpu"
    raise InputError(f"expected a device among auto, cpu and cuda, found {device!r}; use one of those")


def _draws_on_cuda(raster: Raster) -> bool:
    """Whether CUDA is the device for `raster` if the user names none."""
    if raster in ("cpu", "reference"):
        return raster == "reference"
    reason = explain_missing()
    if reason is not None and raster == "auto":
        _warn(reason)
    return reason is None or raster == "gsplat"  # `gsplat` raises its own error when it draws


@functools.cache
def _warn(reason: str) -> None:
    warnings.warn(f"the GPU is not used, and the CPU is: {reason}", stacklevel=4)


class OwnState:
    """What a training has for itself of what torch has for the whole process: the state of the
    random numbers, and whether deterministic algorithms are used."""

    _turn = threading.RLock()

    def __init__(self, device: str, deterministic: bool) -> None:
        self._cuda, self._deterministic = device == "cuda", deterministic
        self._random: list[torch.Tensor] | None = None

    @contextmanager
    def __call__(self) -> Iterator[None]:
        """Use this state inside the `with` block, one thread at a time; then restore that of the
        caller."""
        with self._turn:
            random, before = self._get(), torch.are_deterministic_algorithms_enabled()
            warn_only = torch.is_deterministic_algorithms_warn_only_enabled()
            self._set(random if self._random is None else self._random)
            if self._deterministic:
                torch.use_deterministic_algorithms(True, warn_only=True)
            try:
                yield
            finally:
                self._random = self._get()
                self._set(random)
                if self._deterministic:
                    torch.use_deterministic_algorithms(before, warn_only=warn_only)

    def _get(self) -> list[torch.Tensor]:
        return [torch.get_rng_state(), *([torch.cuda.get_rng_state()] if self._cuda else [])]

    def _set(self, random: list[torch.Tensor]) -> None:
        torch.set_rng_state(random[0])
        if self._cuda:
            torch.cuda.set_rng_state(random[1])
