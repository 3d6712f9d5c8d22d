"""The process that holds usd-core: it says what it cannot do by its exit code."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from scene_experts.files.formats import usd_worker


def test_a_missing_library_has_an_exit_code(monkeypatch, capsys, tmp_path):
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert usd_worker.main(["read", str(tmp_path / "a"), str(tmp_path / "b")]) == usd_worker.MISSING
    assert "pxr" in capsys.readouterr().out


def test_an_old_library_has_an_exit_code(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(usd_worker, "_pxr", lambda name: object())
    assert usd_worker.main(["read", str(tmp_path / "a"), str(tmp_path / "b")]) == usd_worker.MISSING
    assert usd_worker.KIND in capsys.readouterr().out


def test_values_are_looked_up_by_name():
    prim = SimpleNamespace(attributes={"opacities": SimpleNamespace(default=np.ones(2))})
    assert usd_worker._default(prim, "opacities").shape == (2,) and usd_worker._default(prim, "scales") is None


def test_limits_are_limits_of_the_process(monkeypatch):
    resource = pytest.importorskip("resource")
    set_to = {}
    monkeypatch.setattr(resource, "setrlimit", lambda kind, values: set_to.update({kind: values}))
    usd_worker.limit(1 << 30, 7)
    assert set_to[resource.RLIMIT_AS] == (1 << 30, 1 << 30) and set_to[resource.RLIMIT_CPU] == (7, 7)
