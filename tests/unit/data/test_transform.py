"""The map of dataparser_transforms.json from the frame of a file to that of a capture."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data.transform import read_transform
from scene_experts.geometry.rotation import normalise_quats, quat_to_matrix


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape) + sum(shape)), dtype=torch.float64)


def turn() -> torch.Tensor:
    return quat_to_matrix(normalise_quats(random(1, 4)))[0]


def written(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


def test_the_map_of_nerfstudio(tmp_path: Path) -> None:
    """A point p of the reconstruction lies at scale * (R p + t) in the file. The capture may
    have been turned."""
    R, t, p = turn(), random(3), random(3)
    path = written(tmp_path / "d.json", {"transform": torch.cat((R, t[:, None]), 1).tolist(), "scale": 0.25})
    capture: Any = SimpleNamespace(root=tmp_path, applied=None, applied_scale=None)
    back = read_transform(path, capture)
    torch.testing.assert_close(back.scale * back.rotation @ (0.25 * (R @ p + t)) + back.shift, p)
    capture.applied = [[0, 1, 0, 0], [1, 0, 0, 2], [0, 0, -1, 0]]
    back = read_transform(path, capture)
    torch.testing.assert_close(back.scale * back.rotation @ (0.25 * (R @ p + t)) + back.shift, torch.stack((p[1], p[0] + 2, -p[2])))
    capture.applied, capture.applied_scale = None, 2.0  # the capture's unit is half that of the reconstruction, and so are its poses
    back = read_transform(path, capture)
    torch.testing.assert_close(back.scale * back.rotation @ (0.25 / 2 * (R @ p + t)) + back.shift, p)


BAD = (
    [], {}, {"transform": 3}, {"transform": [[1, 0, 0, 0]] * 3}, {"transform": [[1, 0, 0]] * 3},
    {"transform": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, {"transform": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0},
)  # fmt: skip


@pytest.mark.parametrize("content", BAD)
def test_other_files_are_refused(tmp_path: Path, content: Any) -> None:
    with pytest.raises(InputError, match=r"d\.json"):
        read_transform(written(tmp_path / "d.json", content), SimpleNamespace(root=tmp_path, applied=None))  # type: ignore[arg-type]
