"""benchmarks/train_cpu.py: trainings in turn, slice by slice, up to the last iteration."""

import json
import sys

import pytest

import train_cpu
from support.synthetic import make_capture


@pytest.mark.slow
@pytest.mark.parametrize(("iterations", "slices"), [(10, 1), (30, 2), (40, 2)])
def test_the_last_slice_may_be_shorter(tmp_path, monkeypatch, capsys, iterations, slices):
    box = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder
    out = ["--iterations", str(iterations), "--slice", "20", "--out", str(tmp_path / "seconds.json")]
    monkeypatch.setattr(sys, "argv", ["train_cpu.py", str(box), "--recipes", "scaffold-gs", "moe-gs", *out])
    train_cpu.main()
    found = json.loads((tmp_path / "seconds.json").read_text())["box"]
    assert [len(seconds) for seconds in found.values()] == [slices] * 2 and min(min(seconds) for seconds in found.values()) > 0
    assert "| box | scaffold-gs |" in capsys.readouterr().out
