"""The scalar peer: the per-pixel algorithm of 3DGS (Kerbl et al. 2023) as published, in plain C++
on one thread.

Its source is benchmarks/peer. Editable installs of a checkout build it; wheels do not contain it.
"""

from __future__ import annotations

import ctypes
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.bench.measure import Clock
from scene_experts.core.types import Camera, Gaussians
from scene_experts.native import library as native
from scene_experts.render.cpu import convert_camera

NAME = "scalar C++ peer"
WHY_NOT = "the scalar C++ peer is not part of a normal install: run `pip install -e .` in a checkout to build it"


def find(level: str) -> Path | None:
    """Path of the peer compiled with the flags of the library for `level`, or None."""
    beside = native.find(level)
    candidate = beside.with_name(beside.name.replace("se_", "peer_", 1)) if beside else None
    return candidate if candidate is not None and candidate.is_file() else None


def load(level: str | None) -> Peer | None:
    """Load the peer compiled for the instruction set `level` (None: no library), or return None."""
    where = find(level) if level else None
    return Peer(ctypes.CDLL(str(where))) if where else None


class Peer:
    """Renders and differentiates with the scalar code; keeps the state of its last image."""

    def __init__(self, library: ctypes.CDLL) -> None:
        library.peer_new.restype = ctypes.c_void_p
        library.peer_free.argtypes = [ctypes.c_void_p]
        library.peer_composited.restype = ctypes.c_int64
        library.peer_clock_hz.restype = ctypes.c_double
        self._library, self._state = library, ctypes.c_void_p(library.peer_new())

    def __del__(self) -> None:
        self._library.peer_free(self._state)

    @property
    def pairs(self) -> int:
        """Number of (pixel, Gaussian) pairs blended into the last image."""
        return self._library.peer_composited(self._state)

    def clock_hz(self) -> float:
        """Core cycles per second, measured by a loop of dependent additions."""
        return self._library.peer_clock_hz()

    def draw(self, g: Gaussians, camera: Camera, upstream: Tensor, clock: Clock) -> tuple[float, float, Tensor, Tensor]:
        """Seconds forward, seconds backward, the image [H, W, 3] over black, and the gradient of
        the means [M, 3].

        upstream: gradient of the loss with respect to the image, [H, W, 3].
        """
        args = convert_camera(camera)
        inputs = [g.means, g.quats, g.scales, g.opacities, g.colors]
        image, background = torch.empty((camera.height, camera.width, 3)), torch.zeros(3)
        outputs = [torch.empty_like(t) for t in inputs]
        head = [self._state, ctypes.byref(args), ctypes.c_int64(len(g))]
        start = clock()
        self._library.peer_forward(*head, *[native.pointer(t) for t in [*inputs, background, image]])
        middle = clock()
        self._library.peer_backward(*head, *[native.pointer(t) for t in [*inputs[:3], background, upstream, *outputs]])
        return middle - start, clock() - middle, image, outputs[0]
