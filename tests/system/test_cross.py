"""Compare the build for 64-bit ARM (NEON), cross-compiled and run under an emulator, with the portable build of this machine.

Compiling takes a minute, so the test needs SCENE_EXPERTS_CROSS=1 and the tools (Debian: g++-aarch64-linux-gnu, qemu-user).
"""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from support.places import ROOT

TOOLS = ("cmake", "aarch64-linux-gnu-g++", "qemu-aarch64")
pytestmark = pytest.mark.skipif(
    not os.environ.get("SCENE_EXPERTS_CROSS") or not all(map(shutil.which, TOOLS)),
    reason=f"set SCENE_EXPERTS_CROSS=1 and install {', '.join(TOOLS)}",
)


def sums(folder: Path, *configure: str, run: tuple[str, ...] = ()) -> dict[str, tuple[float, ...]]:
    """Build tests/cross/raster_check.cpp with these settings and return what it prints."""
    subprocess.run(["cmake", "-S", str(ROOT), "-B", str(folder), "-DSCENE_EXPERTS_CHECK=ON", *configure], check=True, capture_output=True)
    subprocess.run(["cmake", "--build", str(folder), "--target", "raster_check"], check=True, capture_output=True)
    text = subprocess.run([*run, str(folder / "raster_check")], check=True, capture_output=True, text=True).stdout
    return {line.split()[0]: tuple(map(float, line.split()[1:])) for line in text.splitlines()}


def test_arm_agrees(tmp_path: Path) -> None:
    toolchain = f"-DCMAKE_TOOLCHAIN_FILE={ROOT / 'tests/cross/aarch64-linux-gnu.cmake'}"
    arm = sums(tmp_path / "arm", toolchain, run=("qemu-aarch64", "-L", "/usr/aarch64-linux-gnu"))
    here = sums(tmp_path / "here")
    assert set(arm) == set(here) and len(here) == 10
    for name, (total, norm) in here.items():
        assert arm[name][0] == pytest.approx(total, abs=1e-4 * norm), name
        assert arm[name][1] == pytest.approx(norm, rel=1e-5), name
