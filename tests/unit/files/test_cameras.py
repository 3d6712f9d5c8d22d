"""cameras.json: the centres and rotations of the capture's own frame, test views first."""

import json
from pathlib import Path
from types import SimpleNamespace

import torch

from scene_experts.core.types import Camera
from scene_experts.data.views import View, World
from scene_experts.files.cameras import write_cameras


def test_cameras_in_the_input_frame(tmp_path):
    torch.manual_seed(0)
    world = World(scale=3.0, shift=(1.0, 2.0, -4.0))
    views, centres, rotations = [], [], []
    for i in range(3):
        R, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64))
        centre = torch.randn(3, dtype=torch.float64) * 10
        pose = torch.eye(4, dtype=torch.float64)
        pose[:3, :3], pose[:3, 3] = R, -R @ centre
        K = torch.tensor([[500.0 + i, 0, 320], [0, 510.0, 240.5], [0, 0, 1]])
        camera = world.camera_from_input(Camera(pose.float(), K, 640, 480, id=i))
        views.append(View(f"left/im.{i}.jpg", camera, Path("x")))
        centres.append(centre)
        rotations.append(R.T)
    capture = SimpleNamespace(views=tuple(views), test=(1,), train=(0, 2), world=world)
    write_cameras(tmp_path / "cameras.json", capture)  # type: ignore[arg-type]
    entries = json.loads((tmp_path / "cameras.json").read_text())
    assert [e["id"] for e in entries] == [0, 1, 2] and [e["img_name"] for e in entries] == ["left/im.1", "left/im.0", "left/im.2"]
    for entry, i in zip(entries, (1, 0, 2)):
        torch.testing.assert_close(torch.tensor(entry["position"]).double(), centres[i], rtol=1e-5, atol=1e-5)
        torch.testing.assert_close(torch.tensor(entry["rotation"]).double(), rotations[i], rtol=1e-5, atol=1e-6)
        assert (entry["width"], entry["height"], entry["fx"], entry["fy"], entry["cy"]) == (640, 480, 500.0 + i, 510.0, 240.5)
