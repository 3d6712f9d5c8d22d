"""`export` and `import` from their flags; the files themselves are tested in tests/unit/files."""

import json
from dataclasses import replace

import pytest

from scene_experts.arguments.parse import HelpAsked
from scene_experts.commands.files import export, import_
from scene_experts.core.errors import InputError, RunError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.files import registry
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.files.standard import Written
from scene_experts.render import choose
from scene_experts.scene.anchors.mlp import MLP
from scene_experts.training import loop as train
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from support.messages import naming
from support.synthetic import make_capture


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=naming(tmp_path)):
        export([str(tmp_path), "--no-measure"])


def test_a_source_that_is_no_result_is_refused(tmp_path):
    with pytest.raises(InputError):
        import_([str(tmp_path / "nothing"), "--data", str(tmp_path), "--out", str(tmp_path / "run")])


@pytest.mark.parametrize("command", [export, import_])
def test_the_help_lists_every_format(command):
    with pytest.raises(HelpAsked) as asked:
        command(["--help"])
    text = " ".join(str(asked.value).split())  # however its lines are wrapped
    for name in registry.format_names():
        assert registry.about(name) in text


def test_an_unknown_format_is_answered_with_the_nearest(run):
    with pytest.raises(InputError, match=naming("compactt", "compact")):
        export([str(run), "--format", "compactt"])


def test_flags_reach_the_bake(tmp_path, capsys):
    folder = make_capture(tmp_path / "capture", views=9, size=(48, 32), points=250).folder
    config = RunConfig(replace(RECIPES["scaffold-gs"][1], iterations=300), Data(folder), stop_at=10)
    run_folder.prepare(tmp_path / "run", config, resume=False)
    capture = captures.load(config.data)
    list(train.train(config.train, train.Job(config, tmp_path / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    flags = ["--sh-degree", "1", "--max-gaussians", "90", "--prune", "0.01", "--refine", "3", "--frame", "trained"]
    assert export([str(tmp_path / "run"), "--format", "spz", *flags]) == 0
    out, file = capsys.readouterr().out, tmp_path / "run" / "scene.spz"
    assert str(file) in out and "degree 1" in out
    assert len(registry.read(file)) <= 90
    about = json.loads((tmp_path / "run" / "scene.spz.json").read_text())
    assert about["command"].startswith("scene-experts export ") and about["command"].endswith("--frame trained")
    assert about["bake"]["prune"] == 0.01 and about["bake"]["refine"]["iterations"] == 3
    with pytest.raises(InputError, match="--prune"):
        export([str(tmp_path / "run"), "--format", "ply", "--prune", "2"])


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    root = tmp_path_factory.mktemp("run")
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=250).folder
    config = RunConfig(replace(RECIPES["scaffold-gs"][1], iterations=300), Data(folder), stop_at=2)
    run_folder.prepare(root / "run", config, resume=False)
    capture = captures.load(config.data)
    list(train.train(config.train, train.Job(config, root / "run"), capture, choose("auto", "cpu")))
    write_result_folder(run_folder.open_run(root / "run"), capture)
    capture.images.close()
    return root / "run"


def test_settings_of_other_formats_are_not_dropped_in_silence(run):
    for format in ("compact", "anchors"):
        with pytest.raises(InputError, match=naming("--sh-degree", format)):
            export([str(run), "--format", format, "--sh-degree", "1"])


def test_a_name_of_another_format_and_a_place_that_takes_no_file_are_refused_before_the_work(run, tmp_path):
    with pytest.raises(InputError, match=naming("spz", "x.ply")):
        export([str(run), "--format", "spz", "--out", str(tmp_path / "x.ply"), "--refine", "100000"])
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match=naming("x.ply", "--out")):
        export([str(run), "--format", "ply", "--out", str(tmp_path / "file" / "x.ply"), "--refine", "100000"])


def test_a_compact_file_is_whole_without_the_capture(run, tmp_path, capsys):
    gone = run.parent / "capture"
    gone.rename(run.parent / "elsewhere")
    try:
        assert export([str(run), "--out", str(tmp_path / "a.compact")]) == 0
        assert "--data" in capsys.readouterr().out
        assert export([str(run), "--out", str(tmp_path / "b.compact"), "--data", str(run.parent / "elsewhere")]) == 0
        assert "--data" not in capsys.readouterr().out
    finally:
        (run.parent / "elsewhere").rename(gone)


def test_networks_that_the_layout_cannot_say_are_told(run, tmp_path, capsys, monkeypatch):
    assert export([str(run), "--format", "anchors", "--out", str(tmp_path / "plain")]) == 0
    assert "warning" not in capsys.readouterr().out
    forward = MLP.forward
    monkeypatch.setattr(MLP, "forward", lambda self, *given: (forward(self, *given)[0] * (0.9 if self.attribute == "color" else 1.0), None))
    assert export([str(run), "--format", "anchors", "--out", str(tmp_path / "other")]) == 0
    out = capsys.readouterr().out
    assert "warning" in out and "color" in out


@pytest.mark.parametrize(("format", "said"), [("html", "--target-mb 20"), ("baked-html", "--max-gaussians 200000")])
def test_the_hint_for_a_heavy_page_is_an_option_of_its_format(run, tmp_path, capsys, monkeypatch, format, said):
    page = Written(tmp_path / "a.html", 30_000_000, 1, ("wrote",), format)
    monkeypatch.setattr("scene_experts.files.export.export_several", lambda *_, **__: [page])
    assert export([str(run), "--format", "html"]) == 0
    assert said in capsys.readouterr().out


def test_a_relative_path_of_the_capture_is_no_choice_of_the_training(run, tmp_path, capsys, monkeypatch):
    assert export([str(run), "--format", "ply", "--out", str(tmp_path / "a.ply"), "--refine", "0", "--no-measure"]) == 0
    monkeypatch.chdir(run.parent)
    capsys.readouterr()
    assert import_([str(tmp_path / "a.ply"), "--data", "capture", "--out", str(tmp_path / "imported")]) == 0
    assert "--path" not in capsys.readouterr().out


def test_a_page_of_a_size_has_room_for_the_photographs_that_there_are(run, tmp_path):
    plain = ["--format", "html", "--no-measure", "--photographs"]
    assert export([str(run), *plain, "--out", str(tmp_path / "a.html")]) == 0
    whole = (tmp_path / "a.html").stat().st_size
    assert export([str(run), *plain, "--target-mb", str((whole + 8000) / 1e6), "--out", str(tmp_path / "b.html")]) == 0
    assert (tmp_path / "b.html").stat().st_size <= whole + 8000
