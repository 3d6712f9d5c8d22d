"""The pretended CUDA device and `host_step.py`, as far as they work without CUDA's headers and torch for CUDA."""

import ctypes
import re
import shutil
import subprocess
import sys

import pytest
import torch

import host_step
from pretended_cuda import counts, start
from support.places import ROOT

SOURCES = ROOT / "benchmarks" / "pretended_cuda"


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    if sys.platform != "linux" or shutil.which("gcc") is None:
        pytest.skip("gcc on Linux is needed")
    made = tmp_path_factory.mktemp("device") / "device.so"
    subprocess.run(["gcc", "-Wall", "-Werror", "-shared", "-fPIC", str(SOURCES / "device.c"), "-o", str(made)], check=True)
    return made


@pytest.fixture
def device(library, monkeypatch):
    monkeypatch.setenv(start.MARK, str(library))
    made = counts.Device()
    made.clear()
    return made


def download(device, size):
    to = ctypes.c_int64(-1)
    device.library.download(ctypes.byref(to), ctypes.c_size_t(size))
    return to.value if size == 8 else ctypes.c_int32(to.value).value


def test_copies_of_a_size_get_its_answers_in_order_and_then_the_last(device):
    device.answer([56, 280], [1200])
    assert [download(device, size) for size in (4, 8, 4, 4, 8)] == [56, 1200, 280, 280, 1200]
    assert device.downloads() == [4, 8, 4, 4, 8]
    device.answer([7], [])
    assert [download(device, size) for size in (4, 8)] == [7, 0] and device.downloads() == [4, 8]


def test_launches_are_counted_and_take_the_time_of_their_names(device, tmp_path, capfd):
    names, counter = [b"sort", b"blend forward"], ctypes.c_uint64(0)
    for address, name in enumerate(names, 1):
        device.library.add_kernel(ctypes.c_void_p(address), name)
    (tmp_path / "times.txt").write_text("blend 40.5\n")
    device.set_times(tmp_path / "times.txt")
    device.speeds.clock = 0
    for address in (1, 2, 2):
        device.library.launch_kernel(ctypes.c_void_p(address), ctypes.byref(counter))
    assert counter.value == 3 and device.take_busy() == pytest.approx(2.5 + 2 * 40.5) and device.take_busy() == 0
    device.report()
    assert sorted(capfd.readouterr().out.splitlines()) == ["       1  sort", "       2  blend forward"]
    device.clear()
    device.report()
    assert capfd.readouterr().out == ""


def test_a_wait_ends_with_the_device_s_work(device):
    device.speeds.clock = 1
    device.library.work(ctypes.c_double(3000))
    device.library.wait_for_device()
    found = device.counts()
    device.speeds.clock = 0
    assert found["waits"] == 1 and found["waited ns"] > 1e6


def test_python_knows_the_order_of_the_structures():
    header = (SOURCES / "device.h").read_text()
    fields = {name: re.findall(r"(?:uint64_t|double|int64_t) (\w+);", text) for text, name in re.findall(r"{([^{}]*)} (\w+);", header)}
    assert fields["Counts"] == [name.replace(" ", "_") for name in counts.COUNTS]
    assert fields["Speeds"] == [*counts.SPEEDS, "clock"]
    assert f"#define MOST_ANSWERS {counts.MOST}" in header


def test_the_numbers_that_the_host_waits_for_are_read_by_size():
    assert host_step.parse_reads("4:5 8:7 4:6") == ([5, 6], [7])
    with pytest.raises(SystemExit, match=r"4:NUMBER"):
        host_step.parse_reads("16:5")


def test_ratios_are_to_the_peer():
    meters = []
    for name, milliseconds in (("scaffold-gs", [3.0, 9.0, 2.0]), ("plain gsplat", [2.0, 1.0, 2.5])):
        counted = dict.fromkeys(counts.COUNTS, 30)
        meters.append(host_step.Meter(name, None, ([], []), milliseconds, milliseconds, milliseconds, counted, [4, 4, 8]))
    head, ours, peer = host_step.format_table(meters).splitlines()
    assert ours.split()[:6] == ["scaffold-gs", "3.000", "2.000", "1.50", "3.000", "1.50"] and ours.split()[-2:] == ["10.0", "4,4,8"]
    assert peer.split()[4] == "1.00" and "sizes read" in head


@pytest.mark.skipif(torch.version.cuda is not None, reason="torch is built for CUDA")
def test_without_torch_for_cuda_one_sentence_says_so(tmp_path, monkeypatch):
    monkeypatch.delenv(start.MARK, raising=False)
    with pytest.raises(SystemExit, match=r"without CUDA|gcc"):
        host_step.main(["--data", str(tmp_path), "scaffold-gs"])
