"""tools/wheels.py: what it tells CMake, and the wheels that it refuses. `make wheels` runs it."""

import importlib.util
import os
import sys
import zipfile

import pytest

from support.places import ROOT


@pytest.fixture(scope="module")
def wheels():
    spec = importlib.util.spec_from_file_location("wheels", ROOT / "tools" / "wheels.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["wheels"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["wheels"]


def test_a_toolchain_names_a_compiler_that_can_be_started(wheels, tmp_path):
    for name, target in wheels.TARGETS.items():
        folder = tmp_path / name
        folder.mkdir()
        text = wheels.write_toolchain(target, folder).read_text()
        assert f"CMAKE_SYSTEM_NAME {target.system})" in text and str(folder / "c++") in text
        assert os.access(folder / "c++", os.X_OK) and target.triple in (folder / "c++").read_text()


def library(target):
    """The first bytes of a library for a target."""
    data = bytearray(200) + b"se_abi_version"
    data[: len(target.magic)] = target.magic
    place, code = target.machine
    if target.system == "Windows":
        data[60], place = 100, place + 100
    data[place : place + len(code)] = code
    return bytes(data)


def test_a_wheel_needs_every_library_for_its_own_processor(wheels, tmp_path):
    mac, windows = wheels.TARGETS["macos-arm64"], wheels.TARGETS["windows-x86_64"]

    def checked(target, *libraries):
        path = tmp_path / "a.whl"
        with zipfile.ZipFile(path, "w") as archive:
            for level, data in libraries:
                archive.writestr(f"scene_experts/_native/se_{level}{target.suffix}", data)
        return wheels.check(path, target)

    assert "1 libraries" in checked(mac, ("portable", library(mac)))
    assert "3 libraries" in checked(windows, *((level, library(windows)) for level in windows.levels))
    for libraries in ((), (("portable", library(windows)),), (("portable", library(mac)[:150]),)):
        with pytest.raises(SystemExit):
            checked(mac, *libraries)
