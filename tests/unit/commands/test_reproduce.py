"""`scene-experts reproduce`: its words and its exit codes. What it makes is tested in tests/unit/reproduce."""

import pytest

from scene_experts import cli

pytest.importorskip("matplotlib")


@pytest.mark.slow
def test_a_failure_is_told_at_the_end(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    (tmp_path / "empty" / "transforms.json").touch()
    assert cli.main(["reproduce", "fig5", "--captures", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 1
    found = capsys.readouterr()
    assert "FAILED" in found.out and "1" in found.err and "Traceback" not in found.err


def test_words_that_do_not_fit(tmp_path, capsys):
    (tmp_path / "box").mkdir()
    assert cli.main(["reproduce", "table3", "--captures", str(tmp_path / "box"), "--recipes", "scafold-gs", "--dry-run"]) == 2
    assert "'scaffold-gs'" in capsys.readouterr().err
    for flag in ("--captures", "--seeds", "--devices"):
        assert cli.main(["reproduce", "table3", flag, "--dry-run"]) == 2 and flag in capsys.readouterr().err
