"""The memory cap on growth, and the estimate of a frame's buffers."""

import os
import platform
import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.table import Table
from scene_experts.scene.anchors.scene import Anchors, AnchorScene
from scene_experts.training import memory
from scene_experts.training.memory import Largest, anchor_cap, expected_bytes, frame_bytes, row_bytes, used_bytes
from support.messages import naming


def scene(n=100) -> AnchorScene:
    params = {"feature": torch.zeros(n, 32), "offsets": torch.zeros(n, 10, 3), "log_scaling": torch.zeros(n, 6)}
    cells = torch.arange(3 * n).view(n, 3)
    return AnchorScene(Anchors(), Table(params, {"cell": cells, "xyz": cells.float()}), 0.1, 5.0)


def test_a_row_counts_values_gradients_moments_facts_and_statistics():
    assert row_bytes(scene()) == 4 * 4 * (32 + 30 + 6) + 24 + 12 + 4 * 22


MIB = 2**20


@pytest.fixture
def peak(monkeypatch):
    """A process whose peak and resident memory are this number of bytes."""
    now = [1024 * MIB]
    monkeypatch.setattr(memory, "used_bytes", lambda device: now[0])
    monkeypatch.setattr(memory, "peak_bytes", lambda device: now[0])
    return now


def test_without_a_limit_on_memory_the_users_limit_counts():
    assert anchor_cap(scene(), 7, 0.0, Largest()) == 7 and anchor_cap(scene(), 0, 0.0, Largest()) == 0


def test_growth_fills_half_of_what_is_left(peak):
    measured = Largest(searched=100, searching=1024 * MIB, level=1024 * MIB)  # the table needs nothing that was measured
    room = (0.92 * 2048 * MIB - 1024 * MIB - 100 * row_bytes(scene()) * 3 // 4) / 2  # less the copy of a save
    assert anchor_cap(scene(), 0, 2.0, measured) == 100 + int(room / (3 * row_bytes(scene())))
    assert anchor_cap(scene(), 150, 2.0, measured) == 150
    assert anchor_cap(scene(), 0, 1.0, measured) == 100  # nothing left: no more rows


def test_growth_assumes_that_the_peak_grows_with_the_rows(peak):
    """512 MiB above the level belong to 100 rows: 5 MiB each."""
    measured = Largest(searched=100, searching=1024 * MIB, level=512 * MIB)
    assert 100 + 75 <= anchor_cap(scene(), 0, 2.0, measured) <= 100 + 0.5 * 100 * (0.92 * 2048 - 1024) / 512


def test_a_search_in_a_table_that_has_grown_since_needs_more(peak):
    peak[0] = 900 * MIB
    grown = Largest(searched=50, searching=900 * MIB, level=500 * MIB)  # 400 MiB for 50 rows: 800 MiB for the 100 rows now
    assert expected_bytes(scene(), grown) == 1300 * MIB
    assert anchor_cap(scene(), 0, 1.3, grown) == 100 < anchor_cap(scene(), 0, 1.6, grown)


def test_what_no_frame_has_shown_yet_is_reserved(peak):
    seen = Largest(gaussians=1000, rows=100, searched=100, searching=1024 * MIB, level=1024 * MIB)
    assert expected_bytes(scene(), seen) == 1024 * MIB + 100 * row_bytes(scene()) * 3 // 4  # the copy of a save
    transparent = replace(seen, gaussians=400)  # 100 visible rows of 10 Gaussians
    assert expected_bytes(scene(), transparent) == 1024 * MIB + int(600 * memory.gaussian_bytes())
    assert expected_bytes(scene(), replace(seen, searched=0)) == 1024 * MIB + 360 * 1000


@pytest.mark.parametrize("begun", [True, False])
def test_a_start_that_cannot_fit_says_so(begun, peak):
    rows, learned = 100_000, 4 * (32 + 30 + 6) * 100_000
    for largest, needed in (
        (Largest(), 2**30 + learned * (1 if begun else 3) + frame_bytes(rows, 0)),
        (seen := Largest(gaussians=9, rows=9), expected_bytes(scene(rows), seen) + (0 if begun else 2 * learned) + MIB),
    ):
        memory.check_start(scene(rows), begun, 0.0, largest)
        memory.check_start(scene(rows), begun, needed * 1.001 / 2**30, largest, MIB)
        with pytest.raises(InputError, match=naming("--max-memory", "100,000")):
            memory.check_start(scene(rows), begun, needed * 0.999 / 2**30, largest, MIB)


def test_the_peak_can_begin_anew():
    cpu = torch.device("cpu")
    assert memory.peak_bytes(cpu) >= 0.9 * used_bytes(cpu)
    held = torch.ones(64 * MIB // 4)
    high = memory.peak_bytes(cpu)
    del held
    memory.give_back()
    memory.forget_peak()
    assert 0 < memory.peak_bytes(cpu) <= high


def test_the_largest_frame_is_remembered():
    largest = Largest()
    for gaussians, rows, pixels in ((10, 8, 400), (30, 3, 100), (20, 5, 200)):
        view = SimpleNamespace(gaussians=range(gaussians), rows=range(rows)), SimpleNamespace(alpha=torch.empty(pixels))
        largest.see(*view)
    assert (largest.gaussians, largest.pixels, largest.rows) == (30, 400, 8)


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
