"""Depth of the pixels of all views: a plane sweep, and what other views say about its depths. The
work is done by the compiled library (csrc/sweep_match.cpp, csrc/sweep_check.cpp)."""

from __future__ import annotations

import ctypes

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from scene_experts.data.dense.pairs import Pairs
from scene_experts.data.dense.pictures import SmallPictures
from scene_experts.native import library as native
from scene_experts.native.api import SeSweep

STRONG, WEAK = 0.4, 0.3  # ZNCC that a depth needs, and that a depth needs to confirm another; agreement tells more than ZNCC
AGREEMENT = 0.015  # largest difference of two depths that confirm each other, relative
CONFIRMED = 2  # views that must confirm a depth


class DepthMaps:
    """Inverse depths of the pixels of V reduced pictures."""

    inverse: Tensor
    """[P] float32, per trained world unit; 0: unknown."""
    score: Tensor
    """[P] float32, ZNCC of the pixel at this depth; -1: unknown."""

    def __init__(self, pictures: SmallPictures, pairs: Pairs, planes: int) -> None:
        """Sweep all views with `planes` planes, at least 3.

        Raises InputError without the compiled library, RunError if memory runs out.
        """
        library = native.require()
        self.pictures, self.pairs, self.planes = pictures, pairs, planes
        self.inverse, self.score = torch.empty(len(pictures.grey)), torch.empty(len(pictures.grey))
        native.check(library.se_sweep_match(ctypes.byref(self._call())), "the plane sweep")

    def _call(self) -> SeSweep:
        own, pairs, at = self.pictures, self.pairs, native.pointer
        return SeSweep(
            *(at(tensor) for tensor in (own.grey, own.start, own.size, own.cameras, pairs.compared, pairs.planes)),
            *(at(tensor) for tensor in (self.inverse, self.score)),
            len(own),
            pairs.compared.shape[1],
            self.planes,
            native.count_threads(),
        )

    def keep_confirmed(self) -> None:
        """Forget each depth whose score is not above STRONG, or that fewer than CONFIRMED other
        views find again."""
        first, others = self.pairs.partners()
        agree = torch.empty(len(self.inverse), dtype=torch.int32)
        at = native.pointer
        code = native.require().se_sweep_agree(ctypes.byref(self._call()), at(first), at(others), STRONG, WEAK, AGREEMENT, at(agree))
        native.check(code, "the plane sweep")
        unknown = agree < CONFIRMED
        self.inverse[unknown], self.score[unknown] = 0.0, -1.0

    def compare(self, xyz: NDArray[np.float64], front: float, near_by: float = 0.02) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """Return for points [n, 3] in how many views they lie in front of the view's depth by more
        than the share `front`, and in how many within the share `near_by` of it."""
        points = torch.from_numpy(np.ascontiguousarray(xyz, dtype=np.float64))
        before, on = (torch.empty(len(points), dtype=torch.int32) for _ in range(2))
        at = native.pointer
        code = native.require().se_sweep_compare(ctypes.byref(self._call()), at(points), len(points), front, near_by, at(before), at(on))
        native.check(code, "the plane sweep")
        return before.numpy(), on.numpy()
