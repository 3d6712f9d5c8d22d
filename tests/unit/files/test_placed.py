"""Cameras of scenes without a capture: around the scene, or those of cameras.json where they see it."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from scene_experts.core.io import write_json
from scene_experts.data.views import World
from scene_experts.files.cameras import camera_entries
from scene_experts.files.placed import AROUND, PHOTOGRAPHED, place_cameras

MIDDLE = torch.tensor([100.0, -7.0, 3.0], dtype=torch.float64)


def positions() -> torch.Tensor:
    return MIDDLE + 4 * torch.randn(400, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_rings_see_the_whole_scene_upright(tmp_path: Path) -> None:
    found = place_cameras(tmp_path / "a.ply", positions(), World())
    assert found.kind == AROUND and len(found.train) == 48 and not found.test
    for view in found.views:
        pose = view.camera.world_to_cam.double()
        local = positions() @ pose[:3, :3].T + pose[:3, 3]
        u, v = view.camera.fx * local[:, 0] / local[:, 2], view.camera.fy * local[:, 1] / local[:, 2]
        inside = (local[:, 2] > view.camera.near) & (u.abs() < view.camera.width / 2) & (v.abs() < view.camera.height / 2)
        assert float(inside.double().mean()) > 0.85 and float(pose[1, 1]) > 0


def test_one_place_and_no_rows_have_cameras(tmp_path: Path) -> None:
    for rows in (MIDDLE.expand(5, 3), torch.zeros(0, 3, dtype=torch.float64)):
        assert all(view.camera.world_to_cam.isfinite().all() for view in place_cameras(tmp_path, rows, World()).views)


def test_cameras_beside_it_are_taken_where_they_see_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    world, origin = World(0.5, (-90.0, 0.0, 0.0)), (80.0, 0.0, 0.0)
    placed = place_cameras(tmp_path / "a.ply", world.from_input(positions()), world)
    write_json(tmp_path / "cameras.json", camera_entries(placed.views, world.seen_from(origin)))
    found = place_cameras(tmp_path / "a.ply", world.from_input(positions()), world, origin)
    assert found.kind == PHOTOGRAPHED
    for a, b in zip(found.views, placed.views):
        assert torch.allclose(a.camera.world_to_cam, b.camera.world_to_cam, atol=1e-4) and a.camera.near == pytest.approx(b.camera.near)
    assert place_cameras(tmp_path / "a.ply", positions() + 1e4, world, origin).kind == AROUND
    assert "do not see the scene" in caplog.text


@pytest.mark.parametrize(
    "entries", [{}, {"cameras": []}, [{}], [1], [{"width": 4, "height": 4, "fx": 1, "fy": 1, "rotation": [[1]], "position": [0]}]]
)
def test_damaged_cameras_are_left_aside(tmp_path: Path, entries: object, caplog: pytest.LogCaptureFixture) -> None:
    write_json(tmp_path / "cameras.json", entries)
    assert place_cameras(tmp_path / "a.ply", positions(), World()).kind == AROUND
    assert entries == {} or "cameras.json is left aside" in caplog.text
