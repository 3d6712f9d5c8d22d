"""The compiled library: finding it, refusing other versions, and explaining its absence."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.native import api
from scene_experts.native import library as native


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A package folder without libraries."""
    native.load.cache_clear()
    monkeypatch.setattr(native, "package_folders", lambda: [tmp_path])
    yield tmp_path
    native.load.cache_clear()


def test_the_last_level_runs_everywhere():
    found = native.list_levels()
    assert found[-1] == "portable" and found == native.LEVELS[-len(found) :]


def test_a_loaded_library_fits_this_processor():
    if native.load() is None:
        assert native.explain_missing()
    else:
        level = native.load().level
        assert native.explain_missing() is None and level in native.list_levels() and native.find(level).is_file()
    assert native.load("no such level") is None and native.find("no such level") is None


def test_a_library_for_other_processors_is_not_loaded(monkeypatch):
    """It would end the process at its first instruction."""
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: "DEFAULT")
    native.load.cache_clear()
    try:
        assert native.load("avx512") is None and native.load("avx2") is None
        with pytest.raises(InputError, match=r"(avx2 is not there or does not run here: choose one of portable|compiled CPU library)"):
            native.require("avx2")
    finally:
        native.load.cache_clear()


def test_a_missing_library_is_explained_in_one_sentence(elsewhere):
    assert native.load() is None and "pip install" in native.explain_missing()


def test_a_library_of_another_version_is_not_used(elsewhere, monkeypatch):
    (elsewhere / "_native").mkdir()
    for name in native.LEVELS:
        (elsewhere / "_native" / f"se_{name}{native._SUFFIX}").touch()
    monkeypatch.setattr(native, "Library", lambda path: SimpleNamespace(se_abi_version=lambda: api.ABI_VERSION + 1))
    assert native.load() is None and "portable" in native.explain_missing()


def test_a_library_that_lacks_a_function_is_not_used(elsewhere, monkeypatch):
    (elsewhere / "_native").mkdir()
    (elsewhere / "_native" / f"se_portable{native._SUFFIX}").touch()
    monkeypatch.setattr(native, "Library", lambda path: SimpleNamespace(se_abi_version=lambda: api.ABI_VERSION))
    assert native.load("portable") is None


def test_require_names_what_is_missing(elsewhere):
    with pytest.raises(InputError):
        native.require()
    with pytest.raises(InputError):
        native.require("avx2")


def test_a_damaged_library_is_not_used(elsewhere):
    (elsewhere / "_native").mkdir()
    for name in native.LEVELS:
        (elsewhere / "_native" / f"se_{name}{native._SUFFIX}").write_bytes(b"cut short")
    assert native.load() is None and native.explain_missing()


def test_pointers():
    value = torch.arange(3.0)
    assert native.pointer(value).value == value.data_ptr() and native.pointer(value[1:]).value == value.data_ptr() + 4
    assert not native.pointer(None).value
    with pytest.raises(AssertionError):
        native.pointer(torch.zeros(4, 4).t()[1:])


@pytest.mark.parametrize(
    ("capability", "expected"),
    [("AVX512", native.LEVELS), ("AVX2", ("avx2", "portable")), ("DEFAULT", ("portable",)), ("SVE256", ("portable",))],
)
def test_levels_follow_the_processor(monkeypatch, capability, expected):
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: capability)
    assert native.list_levels() == expected


SHORT = """
import resource, torch
from pathlib import Path
from scene_experts.training import photometric
from scene_experts.core.errors import RunError
from scene_experts.render import choose
from scene_experts.core.types import Camera, Gaussians

torch.set_num_threads(THREADS)
x, y, n = torch.rand(22, 200_000, 3), torch.rand(22, 200_000, 3), 300_000
means = torch.rand(n, 3) - 0.5 + torch.tensor([0, 0, 2.0])
g = Gaussians(means, torch.rand(n, 4), torch.full((n, 3), 0.02), torch.rand(n), torch.rand(n, 3), torch.arange(n))
camera, draw = Camera(torch.eye(4), torch.tensor([[300.0, 0, 160], [0, 300, 100], [0, 0, 1]]), 320, 200, id=0), choose("cpu", "cpu")
work = {"loss": lambda: photometric.photometric(x, y, 0.2), "picture": lambda: draw(g, camera, torch.zeros(3))}["WHAT"]
pages = int(Path("/proc/self/statm").read_text().split()[0])
limits = resource.getrlimit(resource.RLIMIT_AS)
resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + (16 << 20), limits[1]))
try:
    work()
    print("no shortage")
except RunError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_AS, limits)
work()
print("went on")
"""


@pytest.mark.skipif(not sys.platform.startswith("linux") or native.load() is None, reason="needs the compiled library and Linux's limits")
@pytest.mark.parametrize(("what", "said"), [("loss", "the photometric loss"), ("picture", "drawing 300,000 Gaussians")])
@pytest.mark.slow
def test_a_process_survives_running_out_of_memory(what, said):
    code = SHORT.replace("WHAT", what).replace("THREADS", "2")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[0].startswith(f"{said} ran out of memory: use fewer") and done.stdout.endswith("went on\n")


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="this system does not bind processes to cores")
def test_only_cores_available_to_this_process_count():
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(before)})
    try:
        assert native.count_cores() == 1
    finally:
        os.sched_setaffinity(0, before)
    assert native.count_cores() == len(before)
