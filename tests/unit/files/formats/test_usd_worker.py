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


@pytest.mark.parametrize(
    ("operation", "value", "moves"),
    [
        ("translate", (0, 0, 0), False),
        ("translate:pivot", (0, 1, 0), True),
        ("rotateX", 90.0, True),
        ("scale", (1, 1, 1), False),
        ("scale", (2, 2, 2), True),
        ("orient", SimpleNamespace(imaginary=(0, 0, 0)), False),
        ("orient", SimpleNamespace(imaginary=(0, 1, 0)), True),
        ("transform", np.eye(4), False),
        ("transform", 2 * np.eye(4), True),
        ("translate", None, True),
    ],
)
def test_transforms_that_move_a_prim(operation, value, moves):
    values = {f"xformOp:{operation}": value, "xformOpOrder": ["!resetXformStack!", f"!invert!xformOp:{operation}"]}
    prim = SimpleNamespace(attributes={name: SimpleNamespace(default=v) for name, v in values.items()})
    assert usd_worker._moves(prim) is moves and not usd_worker._moves(SimpleNamespace(attributes={}))


def test_limits_are_limits_of_the_process(monkeypatch):
    resource = pytest.importorskip("resource")
    set_to = {}
    monkeypatch.setattr(resource, "setrlimit", lambda kind, values: set_to.update({kind: values}))
    usd_worker.limit(1 << 30, 7)
    assert set_to[resource.RLIMIT_AS] == (1 << 30, 1 << 30) and set_to[resource.RLIMIT_CPU] == (7, 7)
