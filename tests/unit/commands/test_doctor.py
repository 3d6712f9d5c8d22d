"""The report of `scene-experts doctor`, on this machine and on broken ones."""

from __future__ import annotations

import io
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from rich.console import Console

from scene_experts.commands import doctor
from scene_experts.commands.doctor import Check
from scene_experts.core.extras import install_line
from scene_experts.evaluate import weights
from scene_experts.native import library as native
from support.places import ROOT

NAMES = [
    "Python",
    "torch",
    "CUDA",
    "CPU library",
    "gsplat",
    "triton",
    "cores",
    "memory",
    "LPIPS weights",
    "learned features",
    *doctor.EXTRAS,
]


def test_this_machine() -> None:
    checks = doctor.diagnose()
    assert [check.name for check in checks] == NAMES
    assert doctor.exit_code(checks) == 0  # this suite runs on Python >= 3.11 and torch >= 2.7
    for check in checks:
        assert check.found and (check.ok or check.fix or check.name in ("gsplat", "triton")), check  # nothing to install without a GPU
    console = Console(file=io.StringIO(), width=200)
    assert doctor.run(console) == 0 and console.file.getvalue()  # type: ignore[attr-defined]


@pytest.mark.slow
def test_pycolmap_is_not_imported() -> None:
    code = "import sys; from scene_experts.commands import doctor; doctor.diagnose(); "
    code += "sys.exit('pycolmap' in sys.modules or 'viser' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0


def test_without_the_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(native, "explain_missing", lambda: "the compiled CPU library is not installed: install a compiler")
    check = doctor.native_library()
    assert not check.ok and check.found and check.fix == "install a compiler"


def test_old_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.torch, "__version__", "2.6.1+cu124")
    check = doctor.pytorch()
    assert not check.ok and check.needed and "constraints.txt" in check.fix
    monkeypatch.setattr(doctor.torch, "__version__", "2.13.0a0+git1")
    assert doctor.pytorch().ok


def test_absent_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.importlib.util, "find_spec", lambda name: None)
    for name, (_, purpose) in doctor.EXTRAS.items():
        check = doctor.extra(name)
        assert not check.ok and check.fix == install_line(name) and purpose in check.found


def test_every_extra_of_the_project_is_listed() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert set(doctor.EXTRAS) == set(extras) - {"all", "cuda"}  # gsplat and triton have checks of their own


def test_a_check_that_breaks_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken() -> str | None:
        raise OSError("damaged library")

    monkeypatch.setattr(native, "explain_missing", broken)
    check = next(c for c in doctor.diagnose() if "library" in c.name)
    assert not check.ok and "damaged library" in check.found


@pytest.mark.parametrize(
    ("check", "name"), [("cuda", "CUDA"), ("native_library", "CPU library"), ("pytorch", "torch"), ("lpips", "LPIPS weights")]
)
def test_the_report_appears_whatever_check_breaks(monkeypatch: pytest.MonkeyPatch, check: str, name: str) -> None:
    def broken() -> Check:
        raise RuntimeError("CUDA error: all CUDA-capable devices are busy")

    whole = [found.name for found in doctor.diagnose()]
    monkeypatch.setattr(doctor, check, broken)
    checks = doctor.diagnose()
    assert [found.name for found in checks] == whole
    assert "are busy" in next(found.found for found in checks if found.name == name)
    assert doctor.render(checks).splitlines()[-1] and doctor.exit_code(checks) == (check == "pytorch")


def test_verdicts() -> None:
    good = [Check(name, True, "x", needed=name in ("Python", "torch")) for name in NAMES]
    without = lambda *names: [Check(c.name, c.name not in names, "x", "do this", c.needed) for c in good]  # noqa: E731
    verdicts = {doctor.render(checks).splitlines()[-1] for checks in (good, without("gsplat"), without("CUDA", "CPU library"))}
    assert len(verdicts) == 3
    assert doctor.exit_code(without("CUDA", "CPU library")) == 0
    report = doctor.render(without("torch"))
    assert "MISSING   torch" in report and "do this" in report
    assert doctor.exit_code(without("torch")) == 1


def test_little_memory_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    for free, ok in ((2**30, False), (2**32, True), (None, True)):
        monkeypatch.setattr(doctor, "available_bytes", lambda free=free: free)
        assert doctor.memory().ok == ok


def test_damaged_weights_are_not_ok(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of the right name alone does not make scores."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.delenv(weights.VARIABLE, raising=False)
    monkeypatch.setattr(weights, "find_package_folders", lambda *_: [])
    for net in ("vgg", "alex"):
        weights.cache_path(net).parent.mkdir(parents=True, exist_ok=True)
        weights.cache_path(net).write_bytes(b"damaged")
    found = doctor.lpips()
    assert not found.ok and "scores are written without them" in found.found and found.fix == weights.HOW
