"""`scene-experts reproduce` as a user runs it: a real, small experiment on a capture of their own, then again, then with another figure."""

import pytest

from scene_experts import cli
from scene_experts.commands.reproduce import ReproduceCommand, experiments_of, scenes_of
from scene_experts.errors import InputError
from scene_experts.reproduce import store
from synthetic import make_capture

pytest.importorskip("matplotlib")


def test_runs_tables_and_figures_and_nothing_twice(tmp_path, capsys):
    capture = make_capture(tmp_path / "box", views=9).folder
    args = [
        "--captures",
        str(capture),
        "--out",
        str(tmp_path / "out"),
        "--iterations",
        "40",
        "--recipes",
        "moe-gs-e3-top2",
        "moe-gs-e3-no-load",
    ]
    assert cli.main(["reproduce", "fig3", *args]) == 0
    first = capsys.readouterr().out
    assert "2 runs, 0 of them done" in first and len(store.load(tmp_path / "out" / "records")) == 2
    assert (tmp_path / "out" / "fig3_box.png").is_file() and (tmp_path / "out" / "README.md").is_file()
    assert cli.main(["reproduce", "fig3", "fig5", *args]) == 0
    assert "2 runs, 2 of them done" in capsys.readouterr().out and (tmp_path / "out" / "fig5_box.png").is_file()
    assert cli.main(["reproduce", "fig3", *args, "--dry-run"]) == 0
    assert capsys.readouterr().out.count("done") == 2


def test_a_failure_is_told_at_the_end(tmp_path, capsys):
    (tmp_path / "empty").mkdir()
    assert cli.main(["reproduce", "fig5", "--captures", str(tmp_path / "empty"), "--out", str(tmp_path / "out")]) == 1
    found = capsys.readouterr()
    assert "FAILED" in found.out and "1 that failed" in found.err and "Traceback" not in found.err


def test_names_that_are_none(tmp_path, capsys):
    (tmp_path / "box").mkdir()
    assert cli.main(["reproduce", "table3", "--captures", str(tmp_path / "box"), "--recipes", "scafold-gs", "--dry-run"]) == 2
    assert "did you mean 'scaffold-gs'" in capsys.readouterr().err
    with pytest.raises(InputError, match="did you mean 'table1'"):
        experiments_of(ReproduceCommand(("tabel1",)))
    with pytest.raises(InputError, match="found nothing"):
        experiments_of(ReproduceCommand(()))
    with pytest.raises(InputError, match="expected the paper's scenes"):
        scenes_of(ReproduceCommand(("table1",), data=tmp_path))
    with pytest.raises(InputError, match="expected rome"):
        scenes_of(ReproduceCommand(("table1",), data=tmp_path, scenes=("rome",)))
