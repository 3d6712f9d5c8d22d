"""`make gpu`: its plan, its slices and its report, without a GPU."""

import importlib.util
import json
import sys
import time
from pathlib import Path

import pytest

from scene_experts.training.recipes import RECIPES
from support.places import ROOT
from support.pretend.start import explain_missing
from support.synthetic import make_capture

SPEC = importlib.util.spec_from_file_location("gpu", ROOT / "tools" / "gpu.py")
assert SPEC and SPEC.loader
gpu = importlib.util.module_from_spec(SPEC)
sys.modules["gpu"] = gpu  # its dataclasses look their module up
SPEC.loader.exec_module(gpu)

STAGES = [
    gpu.Stage("one", "First", ("a",)),
    gpu.Stage("two", "Second", ("b", "c"), again=True),
    gpu.Stage("three", "Third", ("d",), shown=False),
]


def soon(seconds=1000.0):
    return time.monotonic() + seconds


def test_the_plan_names_files_and_recipes_that_exist(capsys):
    stages = gpu.list_stages(Path("capture"), Path("out"), 8)
    assert len({stage.name for stage in stages}) == len(stages)
    for stage in stages:
        for word in stage.command:
            assert not word.endswith(".py") or (gpu.ROOT / word).is_file(), word
    assert set(gpu.RECIPES) <= set(RECIPES) and [s.name for s in stages if s.name.startswith("cpu")] == ["cpu-1", "cpu-2", "cpu-4", "cpu-8"]
    assert gpu.main(["--data", "capture", "--plan"]) == 0
    assert "train_cuda.py" in capsys.readouterr().out


def test_slices_continue_and_failures_do_not_stop_the_rest(tmp_path):
    calls = []

    def run(stage, seconds):
        calls.append(stage.name)
        if stage.name == "two":
            return 0, "to do" if calls.count("two") == 1 else "table\nall done"
        return (1, "broken") if stage.name == "three" else (0, "fine")

    assert gpu.run_stages(STAGES, tmp_path, soon(0), run) == ["one", "two", "three"] and not calls
    assert gpu.run_stages(STAGES, tmp_path, soon(), run) == ["two", "three"]
    assert gpu.run_stages(STAGES, tmp_path, soon(), run) == []
    assert calls == ["one", "two", "three", "two", "three"]
    report = gpu.format_report(STAGES, tmp_path)
    assert "First" in report and "all done" in report and "Third (FAILED)" in report and "broken" in report


def test_the_report_replaces_what_is_between_the_markers(tmp_path):
    page = tmp_path / "performance.md"
    page.write_text(f"before\n{gpu.BEGIN}\nold\n{gpu.END}\nafter\n")
    gpu.run_stages(STAGES, tmp_path, soon(), lambda stage, seconds: (0, "new\nall done"))
    gpu.write_report(STAGES, tmp_path, page)
    text = page.read_text()
    assert text.startswith("before") and text.endswith("after\n") and "new" in text and "old" not in text
    assert gpu.BEGIN in gpu.REPORT.read_text() and gpu.END in gpu.REPORT.read_text()


def test_a_command_that_takes_too_long_is_ended():
    slow = gpu.Stage("slow", "Slow", (sys.executable, "-c", "import time; print('begun', flush=True); time.sleep(600)"))
    for seconds in (2, 10, 60):  # a busy machine may need longer to begin
        code, text = gpu.run_command(slow, seconds)
        assert code == 124
        if "begun" in text:
            break
    assert "begun" in text


@pytest.mark.parametrize("code", [0, 3])
def test_the_exit_code_and_output_of_a_command(code):
    stage = gpu.Stage("quick", "Quick", (sys.executable, "-c", f"print('out'); raise SystemExit({code})"))
    assert gpu.run_command(stage, 60) == (code, "out\n")


@pytest.mark.slow
def test_a_dry_run_runs_every_command_and_writes_its_tables(tmp_path, capsys):
    if (reason := explain_missing()) is not None:
        pytest.skip(reason)
    capture, page = make_capture(tmp_path / "capture", views=4, size=(24, 16), points=40), gpu.REPORT.read_text()
    line = ["--data", str(capture.folder), "--out", str(tmp_path / "out"), "--dry"]
    for _ in range(4):
        assert gpu.main([*line, "--seconds", "300"]) == 0
        if "all done" in capsys.readouterr().out:
            break
    state = json.loads((tmp_path / "out" / "stages.json").read_text())
    failed = {name: (tmp_path / "out" / f"{name}.txt").read_text()[-2000:] for name, mine in state.items() if mine["failed"]}
    assert not failed, failed
    report = (tmp_path / "out" / "report.md").read_text()
    for row in ("plain gsplat", "L1 + SSIM, Triton", "Top-2 of 5", "gsplat, ", *gpu.RECIPES):
        assert row in report
    assert gpu.REPORT.read_text() == page
