"""Commands that install optional packages, and folders of installed ones."""

import importlib.metadata
import sys
from pathlib import Path

import pytest

from scene_experts.core.extras import find_package_folders, install_line

STATED = ["torch>=2.7", 'gsplat>=1.5.3; extra == "cuda"', 'triton>=3.2; platform_system == "Linux" and extra == "cuda"']


def test_the_packages_are_those_that_the_installed_project_states(monkeypatch: pytest.MonkeyPatch) -> None:
    assert install_line("sfm").startswith("pip install 'pycolmap>=")
    monkeypatch.setattr(importlib.metadata, "requires", lambda name: STATED)
    monkeypatch.setattr(sys, "platform", "linux")
    assert install_line("cuda") == "pip install 'gsplat>=1.5.3' 'triton>=3.2'"
    monkeypatch.setattr(sys, "platform", "win32")
    assert install_line("cuda") == "pip install 'gsplat>=1.5.3'"


def test_a_source_folder_states_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(name: str) -> None:
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "requires", absent)
    assert install_line("exr") == "pip install '.[exr]' in the folder of scene-experts"


def test_packages_are_not_imported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = tmp_path / "weights_probe"
    (package / "weights").mkdir(parents=True)
    (package / "__init__.py").write_text("raise RuntimeError('imported')")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert find_package_folders("weights_probe", "weights") == [package / "weights"]
    assert find_package_folders("weights_probe", "other") == []
    assert find_package_folders("no_such_package_here", "weights") == []
