"""Why gsplat cannot draw, and the memory of a build that failed."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from types import ModuleType

import pytest
import torch

from scene_experts.render import gsplat_install as install
from support.messages import naming

BUILD = """Error building extension 'gsplat_cuda': [1/30] nvcc -c Projection.cu
FAILED: Projection.cuda.o
/usr/bin/nvcc -Werror --generate-dependencies Projection.cu
/usr/include/crt/host_config.h:143:2: error: #error -- unsupported GNU version! gcc versions later than 12 are not supported!
1 error generated.
ninja: build stopped: subcommand failed.
"""


@pytest.fixture
def ask(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    """Ask anew on a machine with a card, with a cache of its own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.version, "hip", None)
    install.explain_missing.cache_clear()
    yield install.explain_missing.__wrapped__
    install.explain_missing.cache_clear()


def there(monkeypatch: pytest.MonkeyPatch) -> tuple[ModuleType, ModuleType]:
    """Pretend that gsplat 1.5.3 with its CUDA code is installed."""
    library, backend = ModuleType("gsplat"), ModuleType("gsplat.cuda._backend")
    library.fully_fused_projection = lambda means, opacities: None  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "gsplat", library)
    monkeypatch.setitem(sys.modules, "gsplat.cuda._backend", backend)
    return library, backend


def test_why_it_is_not_available(monkeypatch: pytest.MonkeyPatch, ask) -> None:
    monkeypatch.setitem(sys.modules, "gsplat", None)  # as for a missing module
    assert re.match(naming("not installed", "pip install 'gsplat", "--device cpu"), ask())
    assert not install.is_likely()
    library, backend = there(monkeypatch)
    assert ask() is None and install.is_likely()
    backend._C = None  # type: ignore[attr-defined]
    assert "nvcc" in ask() and "CUDA toolkit" in ask()
    library.fully_fused_projection = lambda means: None  # type: ignore[attr-defined]
    assert "1.5.3" in ask()
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert "CUDA device" in ask() and not install.is_likely()
    monkeypatch.setattr(torch.version, "hip", "6.4")
    assert "ROCm 6.4" in ask() and "pip" not in ask()


def test_a_build_that_failed_is_tried_once_and_told_by_its_own_line(monkeypatch: pytest.MonkeyPatch, ask, tmp_path: Path) -> None:
    there(monkeypatch)
    tried = []

    def build(name: str) -> ModuleType:
        tried.append(name)
        if name == "gsplat":
            return sys.modules[name]
        raise RuntimeError(BUILD)

    monkeypatch.setattr(install.importlib, "import_module", build)
    monkeypatch.setenv("CUDA_HOME", "/opt/cuda")
    first = ask()
    assert re.match(naming("unsupported GNU version", "CUDA_HOME is /opt/cuda", f"CUDA toolkit {torch.version.cuda}"), first)
    assert "ninja" not in first and len(tried) == 2
    again = ask()
    assert again.startswith(first) and "doctor" in again and len(tried) == 2, "it is not built again"
    assert not install.is_likely()
    monkeypatch.setenv("CUDA_HOME", "/opt/other")
    assert "/opt/other" in ask() and len(tried) == 4, "another toolkit is another try"
    install.try_again()
    assert "tried before" not in ask() and len(tried) == 6
    (tmp_path / "scene-experts" / "gsplat.json").write_text(json.dumps(["damaged"]))
    ask()
    assert len(tried) == 8


def test_another_failure_is_told_whole_and_not_remembered(monkeypatch: pytest.MonkeyPatch, ask) -> None:
    there(monkeypatch)

    def fails(name: str) -> ModuleType:
        raise RuntimeError("\nThe detected CUDA version (12.4) mismatches the version that was used to compile\nPyTorch (13.0).\n")

    monkeypatch.setattr(install.importlib, "import_module", fails)
    assert "(12.4) mismatches the version that was used to compile PyTorch (13.0)" in ask()
    assert install.recall_failure() is None


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (BUILD, "/usr/include/crt/host_config.h:143:2: error: #error"),
        ("x\na.cu(3): error C2065: undeclared\nninja: stopped", "a.cu(3): error C2065"),
        ("-Werror -x\ncc1plus: fatal error: cuda_runtime.h: No such file", "cc1plus: fatal error"),
        ("nothing here\nthe end", "the end"),
    ],
)
def test_the_line_of_the_compiler_that_tells_the_error(text: str, line: str) -> None:
    assert install.find_error_line(text).startswith(line)
