import torch

from scene_experts.scene.select import AllAnchors, visible_rows
from scene_experts.table import Table
from scene_experts.types import Camera

CAMERA = Camera(torch.eye(4), torch.eye(3), 4, 4)


def test_all_anchors_then_the_visibility_filter():
    xyz = torch.arange(12.0).reshape(4, 3)
    table = Table({"a": torch.zeros(4, 1)}, {"xyz": xyz})
    even = lambda means, scales, camera: means[:, 0] % 2 == 0  # noqa: E731
    assert AllAnchors()(table, CAMERA, 1, True) is None
    assert visible_rows(None, xyz, xyz, CAMERA, even).tolist() == [0, 2]


def test_a_selection_is_filtered_and_keeps_row_numbers():
    xyz = torch.arange(12.0).reshape(4, 3)
    even = lambda means, scales, camera: means[:, 0] % 2 == 0  # noqa: E731
    assert visible_rows(torch.tensor([1, 2, 3]), xyz, xyz, CAMERA, even).tolist() == [2]
    assert visible_rows(torch.tensor([], dtype=torch.long), xyz, xyz, CAMERA, even).tolist() == []
