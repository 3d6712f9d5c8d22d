"""The memory cap on growth, and the estimate of a frame's buffers."""

import os
import platform
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.training import memory
from scene_experts.training.memory import Largest, anchor_cap, frame_bytes, row_bytes, used_bytes
from support.messages import naming


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
    assert bare == 100 + int((2**30 - 100 * row_bytes(scene())) / 2 / (3 * row_bytes(scene())))
    drawn = anchor_cap(scene(), 0, 2.0, Largest(gaussians=500, pixels=400_000))
    assert 100 < drawn < bare / 1.5
    assert anchor_cap(scene(), 150, 2.0, Largest()) == 150
    assert anchor_cap(scene(), 0, 0.5, Largest()) == 100  # nothing left: no more rows


@pytest.mark.parametrize("begun", [True, False])
def test_a_start_that_cannot_fit_says_so(begun, monkeypatch):
    monkeypatch.setattr(memory, "used_bytes", lambda device: 2**30)
    rows, learned = 100_000, 4 * (32 + 30 + 6) * 100_000
    needed = (2**30 + learned * (1 if begun else 3)) / 2**30
    memory.check_start(scene(rows), begun, 0.0)
    memory.check_start(scene(rows), begun, needed * 1.001)
    with pytest.raises(InputError, match=naming("--max-memory", "100,000")):
        memory.check_start(scene(rows), begun, needed * 0.999)


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


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="glibc's own setting")
def test_where_no_process_file_is_the_most_ever_held_counts(monkeypatch):
    held = memory.used_bytes(torch.device("cpu"))
    monkeypatch.setattr(memory.Path, "read_text", lambda self: (_ for _ in ()).throw(FileNotFoundError()))
    assert memory.used_bytes(torch.device("cpu")) >= 0.9 * held
    monkeypatch.setitem(sys.modules, "resource", None)
    assert memory.used_bytes(torch.device("cpu")) == 0


@pytest.mark.slow
def test_freed_arrays_are_used_again():
    script = (
        "import resource, torch; from scene_experts.training.memory import reuse_freed; took = reuse_freed()\n"
        "count = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt\n"
        "for _ in range(4): torch.ones(10_000_000)\n"
        "before = count()\n"
        "for _ in range(20): torch.ones(10_000_000)\n"
        "print(took, count() - before)"
    )
    plain = {k: v for k, v in os.environ.items() if not k.startswith("MALLOC_") and k != "GLIBC_TUNABLES"}
    for extra, expected in (({}, "True"), ({"MALLOC_ARENA_MAX": "2"}, "False")):
        found = subprocess.run([sys.executable, "-c", script], env=plain | extra, capture_output=True, text=True, check=True).stdout.split()
        assert found[0] == expected
        share = int(found[1]) / (20 * 9766)  # of the arrays' pages that were new: now and then the heap is cut short between two of them
        assert share < 0.5 if expected == "True" else share > 0.9
