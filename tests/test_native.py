"""The compiled library is found, refused when it is of another version, and its absence explained."""

import ctypes
from types import SimpleNamespace

import pytest
import torch

import scene_experts
from scene_experts import native


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """A package folder without libraries."""
    native.load.cache_clear()
    monkeypatch.setattr(scene_experts, "__path__", [str(tmp_path)])
    yield tmp_path
    native.load.cache_clear()


def test_levels_end_with_the_one_that_runs_everywhere():
    found = native.levels()
    assert found[-1] == "portable" and found == native.LEVELS[-len(found) :]


def test_a_loaded_library_is_one_of_this_processors():
    if native.load() is None:
        assert native.why_not()
    else:
        assert native.why_not() is None and native.load().level in native.levels() and native.path(native.load().level).is_file()
    assert native.load("no such level") is None and native.path("no such level") is None


def test_no_library_is_one_sentence_that_says_what_to_do(elsewhere):
    assert native.load() is None and "not installed" in native.why_not() and "pip install ." in native.why_not()


def test_a_library_of_another_version_is_not_used(elsewhere, monkeypatch):
    (elsewhere / "_native").mkdir()
    for name in native.LEVELS:
        (elsewhere / "_native" / f"se_{name}{native._SUFFIX}").touch()
    monkeypatch.setattr(ctypes, "CDLL", lambda where: SimpleNamespace(se_abi_version=lambda: native.ABI_VERSION + 1))
    assert native.load() is None and "does not fit" in native.why_not() and "portable" in native.why_not()


def test_a_damaged_library_is_not_used(elsewhere):
    (elsewhere / "_native").mkdir()
    for name in native.LEVELS:
        (elsewhere / "_native" / f"se_{name}{native._SUFFIX}").write_bytes(b"cut short")
    assert native.load() is None and "does not fit" in native.why_not()


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
    assert native.levels() == expected
