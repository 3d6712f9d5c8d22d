import io
from pathlib import Path

import torch
from rich.console import Console

from scene_experts.core.progress import Speedometer
from scene_experts.scene import Traits
from scene_experts.strategy import Edit
from scene_experts.training.course import Course
from scene_experts.training.events import Densified, Exported, Finished, Previewed, Saved, Started, Stepped, Stopped
from scene_experts.training.progress import ProgressBar, TrainingProgress, format_duration


def test_a_log_file_gets_plain_lines():
    out = io.StringIO()
    with TrainingProgress(Console(file=out, width=200), every=0.0) as show:
        show(Started(0, 200, 1234, Traits("anchors", "anchors", 0.02, activation=True)))
        show(Stepped(10, {"l1": 0.05, "dssim": 0.02}, 21.5, 1300, 800, 4000, 0.61, 1.0, {}))
        show(Densified(100, Edit(10, 0, 1310, capped=True)))
        show(Saved(200, Path("a/b")))
        show(Exported(200, Path("a/c"), notes=("measured something (3 s)",)))
        show(Finished(200, 75.0))
        show(Stopped(100, "SIGINT"))
    text = out.getvalue()
    parts = (
        "1,234 anchors on a lattice of 0.02",
        "10/200",
        "l1 0.0500",
        "training PSNR 21.50",
        "anchors 1,300",
        "active 61 %",
        "left",
        "cap on anchors",
        "1:15",
        "measured something (3 s)",
    )
    for part in parts:
        assert part in text, part
    assert "--resume" in text and "\x1b" not in text


def test_a_run_that_ends_before_its_first_checkpoint_is_not_called_saved(tmp_path):
    out = io.StringIO()
    with TrainingProgress(Console(file=out, width=200), every=0.0, out=tmp_path) as show:
        show(Stopped(0, "SIGTERM"))
        assert "nothing is saved" in out.getvalue() and "--resume" not in out.getvalue()
        (tmp_path / "checkpoints").mkdir()
        (tmp_path / "checkpoints" / "ckpt_000010.safetensors").touch()
        show(Stopped(10, "SIGTERM"))
    assert "--resume" in out.getvalue()


def test_a_narrow_terminal_shows_the_time_that_is_left():
    console = Console(file=io.StringIO(), force_terminal=True, width=60)
    with TrainingProgress(console, every=0.0) as show:
        show(Started(0, 200, 1234, Traits("anchors", "anchors", 0.02, activation=True)))
        show(Stepped(10, dict.fromkeys(("l1", "dssim", "volume", "opacity", "load"), 0.05), 21.5, 1300, 800, 4000, 0.61, 1.0, {}))
    shown = next(line for line in console.file.getvalue().split("\r") if "10/200" in line)  # type: ignore[attr-defined]
    assert " left " in shown and "load" not in shown


def test_rows_have_the_name_that_the_traits_state():
    out = io.StringIO()
    with TrainingProgress(Console(file=out, width=200), every=0.0) as show:
        show(Started(0, 200, 1234, Traits("gaussians", "Gaussians"), start="1,234 points by a plane sweep"))
        show(Stepped(10, {"l1": 0.05}, 21.5, 1300, 800, 800, 0.0, 1.0, {}))
        show(Densified(100, Edit(10, 0, 1310, capped=True)))
    text = out.getvalue()
    assert all(fact in text for fact in ("1,234", "200", "1,300"))
    assert "anchors" not in text and "active" not in text and "lattice" not in text


def test_the_first_picture_has_its_place():
    out = io.StringIO()
    with TrainingProgress(Console(file=out, width=200), out=Path("runs/a")) as show:
        show(Previewed(500, 0, torch.zeros(2, 2, 3)))
        show(Previewed(1000, 0, torch.zeros(2, 2, 3)))
    assert str(Path("runs/a/previews/000500.png")) in out.getvalue() and "001000" not in out.getvalue()


def test_the_time_left_is_that_of_the_measured_speed(monkeypatch):
    out, clock = io.StringIO(), [0.0]
    monkeypatch.setattr("scene_experts.training.progress.Speedometer", lambda: Speedometer(lambda: clock[0]))
    with TrainingProgress(Console(file=out, width=200), every=0.0) as show:
        show(Started(0, 200, 1234, Traits("anchors", "anchors")))
        for step in (10, 50):
            show(Stepped(step, {"l1": 0.05}, 21.5, 1300, 800, 4000, 0.61, 1.0, {}))
            clock[0] += 4.0
    first, second = [line for line in out.getvalue().splitlines() if "/200" in line]
    assert "-:-- left" in first and "0:15 left  10.0 it/s" in second


def test_the_time_left_counts_iterations_that_take_longer(monkeypatch):
    """From 10 to 50 of 200 iterations in 4 s, and iterations after 100 that take 3 times as long."""
    out, clock = io.StringIO(), [0.0]
    monkeypatch.setattr("scene_experts.training.progress.Speedometer", lambda: Speedometer(lambda: clock[0]))
    with TrainingProgress(Console(file=out, width=200), every=0.0) as show:
        show(Started(0, 200, 1234, Traits("anchors", "anchors"), course=Course(200, 0.0, 100, 3.0)))
        for step, seconds in ((10, 4.0), (50, 5.0), (100, 3.0), (110, 0.0)):
            show(Stepped(step, {"l1": 0.05}, 21.5, 1300, 800, 4000, 0.61, 1.0, {}))
            clock[0] += seconds
    told = [line.split(" left")[0].split()[-1] for line in out.getvalue().splitlines() if "/200" in line]
    assert told[1] == "0:35"  # 50 and 3 x 100 at 10 a second
    assert told[3] == "0:27"  # 3 x 90 at 10 a second: the speed in the cost's unit does not change


def test_durations_are_formatted():
    assert [format_duration(s) for s in (0, 59.6, 61, 3661)] == ["0:00", "1:00", "1:01", "1:01:01"]


def test_a_bar_prints_lines_without_a_terminal():
    console = Console(file=io.StringIO(), force_terminal=False)
    with ProgressBar(console, every=0.0) as tell:
        tell("rendering", 3, 9)
    assert console.file.getvalue() == "rendering: 3 of 9\n"  # type: ignore[attr-defined]
    clock = [0.0]
    with ProgressBar(console, every=0.0) as tell:
        tell.pace = Speedometer(lambda: clock[0])
        tell.what = "refining"
        for done in (100, 200):
            tell("refining", done, 1000)
            clock[0] += 5.0
        tell("measuring", 1, 2)
    lines = console.file.getvalue().splitlines()[1:]  # type: ignore[attr-defined]
    assert lines == ["refining: 100 of 1000", "refining: 200 of 1000, about 0:40 left", "measuring: 1 of 2"]
    quiet = Console(file=io.StringIO(), force_terminal=False)
    with ProgressBar(quiet) as tell:
        tell("rendering", 3, 9)
    assert quiet.file.getvalue() == ""  # type: ignore[attr-defined]
