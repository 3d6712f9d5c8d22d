"""The report of a run that holds no photograph out: its training views."""

from pathlib import Path

import pytest

from scene_experts import cli
from scene_experts.evaluate.photographs import read_photographs
from scene_experts.report.source import read_run
from support.synthetic import make_capture


def test_a_run_without_held_out_views_has_a_report(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    box, run = make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder, str(tmp_path / "run")
    words = ["--data", str(box), "--out", run, "--split", "none", "--iterations", "6", "--preview-every", "0"]
    assert cli.main(["train", "scaffold-gs", *words]) == 0
    assert cli.main(["eval", run, "--no-lpips"]) == 0 and "no view is held out" in caplog.text
    page = (tmp_path / "run/report.html").read_text()
    assert "<h2>Training views</h2>" in page and "other views look worse" in page and "Held-out views" not in page
    assert {each.folder for each in read_photographs(tmp_path / "run")} == {"train"} and len(read_run(tmp_path / "run").photographs) == 9
    assert cli.main(["report", run, "--out", str(tmp_path / "again.html")]) == 0
