"""The memory cap on growth, and the estimate of a frame's buffers."""

from types import SimpleNamespace

import torch

from scene_experts import memory
from scene_experts.memory import Largest, anchor_cap, frame_bytes, row_bytes, used_bytes
from scene_experts.scene.anchors import Anchors, AnchorScene
from scene_experts.table import Table


def scene(n=100) -> AnchorScene:
    params = {"feature": torch.zeros(n, 32), "offsets": torch.zeros(n, 10, 3), "log_scaling": torch.zeros(n, 6)}
    cells = torch.arange(3 * n).view(n, 3)
    return AnchorScene(Anchors(), Table(params, {"cell": cells, "xyz": cells.float()}), 0.1, 5.0)


def test_a_row_counts_values_gradients_moments_facts_and_statistics():
    assert row_bytes(scene()) == 4 * 4 * (32 + 30 + 6) + 24 + 12 + 4 * 22


def test_the_cap_leaves_room_for_rows_and_their_gaussians(monkeypatch):
    monkeypatch.setattr(memory, "used_bytes", lambda device: 2**30)
    assert anchor_cap(scene(), 7, 0.0, Largest()) == 7 and anchor_cap(scene(), 0, 0.0, Largest()) == 0
    bare = anchor_cap(scene(), 0, 2.0, Largest())
    assert bare == 100 + 2**30 // (2 * row_bytes(scene()))
    drawn = anchor_cap(scene(), 0, 2.0, Largest(gaussians=500, pixels=400_000))
    assert 100 < drawn < bare / 1.5
    assert anchor_cap(scene(), 150, 2.0, Largest()) == 150
    assert anchor_cap(scene(), 0, 0.5, Largest()) == 100  # nothing left: no more rows


def test_the_largest_frame_is_remembered():
    largest = Largest()
    for gaussians, pixels in ((10, 400), (30, 100), (20, 200)):
        view = SimpleNamespace(gaussians=range(gaussians)), SimpleNamespace(alpha=torch.empty(pixels))
        largest.see(*view)
    assert (largest.gaussians, largest.pixels) == (30, 400)


def test_a_frame_grows_with_gaussians_pixels_and_pairs():
    base = frame_bytes(1000, 10_000)
    assert frame_bytes(2000, 10_000) > base < frame_bytes(1000, 20_000) and frame_bytes(1000, 10_000, pairs=20) > base


def test_memory_is_counted_where_the_scene_is(monkeypatch):
    monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 12345)
    assert used_bytes(torch.device("cuda")) == 12345
    assert used_bytes(torch.device("cpu")) > 1 << 20
