"""Gaussians of another frame: the map of dataparser_transforms.json, harmonics included."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.formats.splats import Splats
from scene_experts.files.transform import Similarity, read_transform, rotate_harmonics
from scene_experts.geometry import sh
from scene_experts.geometry.rotation import covariance, normalise_quats, quat_to_matrix


def random(*shape: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(len(shape) + sum(shape)), dtype=torch.float64)


def turn() -> torch.Tensor:
    return quat_to_matrix(normalise_quats(random(1, 4)))[0]


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_turn_with_the_scene(degree: int) -> None:
    coefficients, rotation = random(5, (degree + 1) ** 2, 3), turn()
    directions = torch.nn.functional.normalize(random(40, 3), dim=1)
    turned = rotate_harmonics(coefficients, rotation)
    before = torch.einsum("dc,ncx->ndx", sh.basis(directions, degree), coefficients)
    after = torch.einsum("dc,ncx->ndx", sh.basis(directions @ rotation.T, degree), turned)
    torch.testing.assert_close(after, before, atol=1e-10, rtol=0)


def test_places_sizes_and_rotations() -> None:
    s = Splats(random(6, 3).float(), random(6, 3).float(), random(6, 4).float(), random(6).float(), random(6, 16, 3).float())
    move = Similarity(turn(), random(3), 2.5)
    found = move.applied(s)
    torch.testing.assert_close(found.means, 2.5 * (move.rotation @ s.means.double().T).T + move.shift)
    want = 2.5**2 * move.rotation @ covariance(normalise_quats(s.quats.double()), s.log_scales.double().exp()) @ move.rotation.T
    torch.testing.assert_close(covariance(found.quats.double(), found.log_scales.double().exp()), want, rtol=1e-4, atol=1e-6)
    back = move.inverse.applied(found)
    torch.testing.assert_close(back.means.float(), s.means, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(back.sh, s.sh, atol=1e-5, rtol=1e-5)
    p, second = random(3), Similarity(turn(), random(3), 0.3)
    both = move.then(second)
    expected = 0.3 * second.rotation @ (2.5 * move.rotation @ p + move.shift) + second.shift
    torch.testing.assert_close(both.scale * both.rotation @ p + both.shift, expected)


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
