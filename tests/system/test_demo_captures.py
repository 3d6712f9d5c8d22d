"""The shipped captures: what they are, and that their points lie where their photographs show something."""

from __future__ import annotations

import pytest
import torch

from scene_experts.data.capture import Capture
from scene_experts.data.summary import summarise
from support.captures import load
from support.places import DEMO


@pytest.fixture(params=["buddha", "brighton"])
def capture(request: pytest.FixtureRequest) -> Capture:
    return load(DEMO / request.param)


def test_what_they_are(capture: Capture) -> None:
    said = summarise(capture)
    expected = {"buddha": (67, "684x385", 12505), "brighton": (18, "500x280", 7283)}[capture.name]
    assert (said["views"], *said["sizes"], said["points"]) == expected
    assert said["camera_models"] == {"PINHOLE": expected[0]} and said["extent"] == 5.0
    assert (DEMO / capture.name / "ATTRIBUTION.txt").stat().st_size > 100
    assert sum(p.stat().st_size for p in (DEMO / capture.name).rglob("*") if p.is_file()) < 4_000_000


def test_points_project_into_the_photographs_with_their_colour(capture: Capture) -> None:
    """Coloured like the pixel they fall on, far less like a shuffled one: poses, intrinsics, channels and sizes belong together."""
    assert capture.points is not None
    right, wrong = [], []
    shuffled = capture.points.rgb[torch.randperm(len(capture.points.rgb), generator=torch.Generator().manual_seed(0))]
    for view in capture.views[::5]:
        camera = view.camera
        xyz = capture.points.xyz.float() @ camera.world_to_cam[:3, :3].T + camera.world_to_cam[:3, 3]
        px = ((xyz / xyz[:, 2:]) @ camera.K.T)[:, :2]
        inside = (xyz[:, 2] > 0) & (px >= 0).all(1) & (px < torch.tensor([camera.width, camera.height])).all(1)
        assert int(inside.sum()) > 300
        at = px[inside].long()
        seen = capture.frame(camera.id).rgb[at[:, 1], at[:, 0]].float()
        right.append((seen - capture.points.rgb[inside].float()).abs().mean())
        wrong.append((seen - shuffled[inside].float()).abs().mean())
    assert float(torch.stack(right).mean()) < 0.85 * float(torch.stack(wrong).mean())  # points behind the head are seen too
