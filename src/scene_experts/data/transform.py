"""How another frame lies in that of a capture: a rotation, a scale and a shift, as nerfstudio states
them in dataparser_transforms.json."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.io import read_json
from scene_experts.core.reading import budget
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import FARTHEST, number
from scene_experts.core.reading.source import guarding
from scene_experts.data.views import Capture

_ORTHONORMAL = 1e-3


@dataclass(frozen=True)
class Similarity:
    """Maps a point p [3] to scale * rotation p + shift, in float64."""

    rotation: Tensor  # [3, 3]
    shift: Tensor  # [3]
    scale: float = 1.0

    @property
    def inverse(self) -> Similarity:
        back = self.rotation.T
        return Similarity(back, -(back @ self.shift) / self.scale, 1 / self.scale)

    def then(self, other: Similarity) -> Similarity:
        """Return this map followed by another."""
        shift = other.scale * (other.rotation @ self.shift) + other.shift
        return Similarity(other.rotation @ self.rotation, shift, other.scale * self.scale)


def read_transform(path: Path, capture: Capture) -> Similarity:
    """Return the map from the frame of a file to that of a capture.

    path: JSON with `transform`, rows of a 3 x 4 matrix, and `scale`, as nerfstudio writes
    dataparser_transforms.json: a point p of the reconstruction is at scale * (transform p) in the
    file. The poses of a capture may have been turned and scaled first (`Capture.applied`).

    Raises InputError for another file and for a matrix without a rotation.
    """
    found = read_json(path, "transform")
    with guarding(path, budget.JSON, "transform"):
        if not isinstance(found, dict) or "transform" not in found:
            raise Damaged("no transform; nerfstudio's is dataparser_transforms.json")
        scale = number(found.get("scale", 1.0), "the scale", 1e-15, FARTHEST)
        turn = _matrix(found["transform"])
    if capture.applied_scale is not None:  # the file's scale is from the unit of the reconstruction
        with guarding(capture.root, budget.JSON, "capture"):
            scale /= number(capture.applied_scale, "applied_scale", 1e-15, FARTHEST)
    with guarding(path, budget.JSON, "transform"):
        to_file = Similarity(turn.rotation, scale * turn.shift, scale)
    if capture.applied is None:
        return to_file.inverse
    with guarding(capture.root, budget.JSON, "capture"):
        return to_file.inverse.then(_matrix(capture.applied))


def _matrix(rows: Any) -> Similarity:
    """Return the rotation and shift in the rows of a 3 x 4 or 4 x 4 matrix."""
    if not isinstance(rows, list) or len(rows) not in (3, 4) or not all(isinstance(row, list) and len(row) == 4 for row in rows):
        raise Damaged("a matrix of another form than 3 x 4")
    matrix = torch.tensor(
        [[number(v, "an entry of the matrix", -FARTHEST, FARTHEST) for v in row] for row in rows[:3]], dtype=torch.float64
    )
    rotation = matrix[:, :3]
    if not torch.allclose(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=_ORTHONORMAL) or torch.linalg.det(rotation) < 0:
        raise Damaged("a matrix that is no rotation")
    u, _, vh = torch.linalg.svd(rotation)
    return Similarity(u @ vh, matrix[:, 3])
