"""`eval` and `compare` from their flags; the scores themselves are tested in test_evaluate_run.py and test_evaluate_tables.py."""

import pytest

from scene_experts.cli import main
from scene_experts.commands.evaluate import compare, evaluate
from scene_experts.core.errors import InputError
from support.messages import naming
from support.synthetic import make_capture


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=naming(tmp_path)):
        evaluate([str(tmp_path), "--no-lpips"])
    with pytest.raises(InputError):
        compare([str(tmp_path)])


def test_a_run_with_exposures_is_not_told_to_learn_them(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("scene_experts.commands.evaluate.DRIFTS", -100.0)
    folder = make_capture(tmp_path / "box", views=9, size=(24, 16), points=60).folder
    for name, more in (("with", ["--exposure"]), ("without", [])):
        words = ["--data", str(folder), "--out", str(tmp_path / name), "--iterations", "20", "--device", "cpu", "--preview-every", "0"]
        assert main(["train", "scaffold-gs", *words, *more]) == 0
        capsys.readouterr()
        assert main(["eval", str(tmp_path / name), "--no-lpips"]) == 0
        out = capsys.readouterr().out
        assert "aligned with its photograph" in out and ("exposures may differ (train --exposure)" in out) == (not more)
