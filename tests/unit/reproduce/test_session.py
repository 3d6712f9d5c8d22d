"""`scene-experts reproduce` as a user runs it: a real, small experiment on a capture of their own, then again, then with another figure."""

import pytest

from scene_experts import cli
from scene_experts.core.io import write_json
from scene_experts.reproduce import store
from support.records import record
from support.synthetic import make_capture

pytest.importorskip("matplotlib")


@pytest.mark.slow
def test_runs_tables_and_figures_and_nothing_twice(tmp_path, capsys):
    capture = make_capture(tmp_path / "box", views=12, size=(48, 32), points=300).folder
    args = [
        "--captures",
        str(capture),
        "--iterations",
        "40",
        "--recipes",
        "moe-gs-e3-top2",
        "moe-gs-e3-no-load",
    ]
    here = ["--out", str(tmp_path / "out")]
    assert cli.main(["reproduce", "fig3", *args, *here]) == 0
    first = capsys.readouterr().out
    records = store.load(tmp_path / "out" / "records")
    assert "2 runs" in first and len(records) == 2
    assert all(r.results["cpu_seconds"] > 0 and r.results["load"].keys() == {"cores", "start", "end"} for r in records)
    assert (tmp_path / "out" / "fig3_box.png").is_file() and (tmp_path / "out" / "README.md").is_file()
    assert cli.main(["reproduce", "fig3", "fig5", *args, *here]) == 0
    assert len(store.load(tmp_path / "out" / "records")) == 2 and (tmp_path / "out" / "fig5_box.png").is_file()
    assert cli.main(["reproduce", "fig3", *args, *here, "--dry-run"]) == 0
    assert capsys.readouterr().out.count("done ") == 2
    elsewhere = ["--out", str(tmp_path / "other"), "--records", str(tmp_path / "out" / "records")]
    assert cli.main(["reproduce", "fig3", *args, *elsewhere]) == 0
    assert not (tmp_path / "other" / "runs").exists()
    page = (tmp_path / "other" / "README.md").read_text()
    assert "scene-experts reproduce fig3 --captures CAPTURES/box --iterations 40 --recipes" in page and str(tmp_path) not in page


def test_tables_of_what_is_done_without_running_the_rest(tmp_path, capsys):
    (tmp_path / "fox").mkdir()
    args = ["--captures", str(tmp_path / "fox"), "--out", str(tmp_path / "out"), "--iterations", "3000", "--tables-only"]
    store.write(tmp_path / "out" / "records", record("moe-gs", "fox"))
    assert cli.main(["reproduce", "table4", *args]) == 0
    assert "31.50" in (tmp_path / "out" / "table4.md").read_text()
    assert not (tmp_path / "out" / "runs").exists()


def test_a_run_whose_checkpoints_are_gone_costs_its_picture_alone(tmp_path, capsys):
    (tmp_path / "fox").mkdir()
    (tmp_path / "fox" / "transforms.json").touch()
    args = ["--captures", str(tmp_path / "fox"), "--out", str(tmp_path / "out"), "--iterations", "3000", "--recipes", "moe-gs-e3-top2"]
    made = record("moe-gs-e3-top2", "fox")
    store.write(tmp_path / "out" / "records", made)
    folder = tmp_path / "out" / "runs" / "fox" / "moe-gs-e3-top2" / f"seed0-{made.key}"
    write_json(folder / "results.json", made.results)
    assert cli.main(["reproduce", "fig5", *args]) == 0
    said = capsys.readouterr().out
    assert "moe-gs-e3-top2 on fox, seed 0" in said and "README.md" in said


def test_only_runs_that_are_asked_for_are_adopted_and_a_dry_run_writes_nothing(tmp_path, capsys):
    capture = make_capture(tmp_path / "box", views=12, size=(48, 32), points=300).folder
    run, out = str(tmp_path / "run"), ["--out", str(tmp_path / "out")]
    assert cli.main(["train", "moe-gs", "--data", str(capture), "--out", run, "--iterations", "4", "--device", "cpu"]) == 0
    assert cli.main(["eval", run, "--no-lpips", "--device", "cpu"]) == 0
    ask = ["reproduce", "compare", "--recipes", "moe-gs", "scaffold-gs", "--captures", str(capture), "--adopt", run, *out]
    capsys.readouterr()
    assert cli.main([*ask, "--iterations", "5", "--dry-run"]) == 2
    said = capsys.readouterr().err
    assert "moe-gs on box, seed 0" in said and "iterations was 4, is now 5" in said
    assert cli.main([*ask, "--iterations", "4", "--seeds", "1", "--dry-run"]) == 2
    assert "moe-gs on box, seed 0" in capsys.readouterr().err
    assert cli.main([*ask, "--iterations", "4", "--dry-run"]) == 0
    said = capsys.readouterr().out
    assert "done    moe-gs on box" in said and "to run  scaffold-gs on box" in said and not (tmp_path / "out" / "records").exists()
    assert cli.main([*ask, "--iterations", "4", "--tables-only"]) == 0
    assert f"adopted {run}" in capsys.readouterr().out and len(store.load(tmp_path / "out" / "records")) == 1


def recipes_of(capsys, *args: str) -> tuple[int, set[str], set[str]]:
    """How many runs a plan has, and their recipes and seeds."""
    assert cli.main(["reproduce", *args, "--dry-run"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines() if line.startswith(("done ", "to run "))]
    at = [line.index("on") for line in lines]
    return len(lines), {line[i - 1] for line, i in zip(lines, at)}, {line[i + 3].rstrip(":") for line, i in zip(lines, at)}


def test_the_plans_of_the_results_page_are_one_command_each(tmp_path, capsys):
    for name in ("bonsai", "fox", "buddha"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "transforms.json").touch()
    captures = ["--captures", *(str(tmp_path / name) for name in ("bonsai", "fox", "buddha"))]
    suite = ["table1", "table3", "table4", "fig1b", "fig3", "fig5", "fig6", "fig7"]
    count, recipes, _ = recipes_of(capsys, *suite, *captures, "--iterations", "3000", "--resolution", "longest:400")
    assert {"3dgs", "scaffold-gs", "sags", "octree-gs", "moe-gs", "moe-gs-no-cl", "moe-gs-e2-dense", "scaffold-gs-depth6"} <= recipes
    assert count == 3 * len(recipes) == 3 * 25  # moe-gs-e5-top2 is moe-gs, scaffold-gs-depth2 is scaffold-gs
    few = ["--recipes", "scaffold-gs", "moe-gs", "moe-gs-dist", "--iterations", "7000", "--seeds", "0", "1", "2"]
    count, recipes, seeds = recipes_of(capsys, "table1", "appendix", *captures, *few)
    assert recipes == {"scaffold-gs", "moe-gs", "moe-gs-dist"} and seeds == {"0", "1", "2"} and count == 27
