"""`export` and `import` from their flags; the files themselves are tested in test_export_*.py."""

import json
import typing
from dataclasses import replace

import pytest

from scene_experts import run_folder, train
from scene_experts.commands.files import ExportCommand, export, import_
from scene_experts.config import Data, RunConfig
from scene_experts.errors import InputError
from scene_experts.export.standard import FORMATS, read_standard
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from synthetic import make_capture


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected a run folder"):
        export([str(tmp_path), "--no-measure"])


def test_a_source_that_is_no_result_is_refused(tmp_path):
    with pytest.raises(InputError):
        import_([str(tmp_path / "nothing"), "--data", str(tmp_path), "--out", str(tmp_path / "run")])


def test_every_standard_format_can_be_named():
    assert set(typing.get_args(typing.get_type_hints(ExportCommand)["format"])) == {"anchors", "compact", *FORMATS}


def test_flags_reach_the_bake(tmp_path, capsys):
    folder = make_capture(tmp_path / "capture", views=9, size=(48, 32), points=250).folder
    config = RunConfig(replace(RECIPES["scaffold-gs"][1], iterations=300), Data(folder), stop_at=10)
    run_folder.prepare(tmp_path / "run", config, resume=False)
    capture = run_folder.load_capture(config.data)
    list(train.train(config.train, train.Run(config, tmp_path / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    flags = ["--sh-degree", "1", "--max-gaussians", "90", "--prune", "0.01", "--refine", "3", "--frame", "trained"]
    assert export([str(tmp_path / "run"), "--format", "spz", *flags]) == 0
    out, file = capsys.readouterr().out, tmp_path / "run" / "scene.spz"
    assert f"wrote {file}" in out and "harmonics of degree 1, in the trained world" in out and "refined" in out
    assert len(read_standard(file)) <= 90
    about = json.loads((tmp_path / "run" / "scene.spz.json").read_text())
    assert about["command"].startswith("scene-experts export ") and about["command"].endswith("--frame trained")
    assert about["bake"]["prune"] == 0.01 and about["bake"]["refine"]["iterations"] == 3
    with pytest.raises(InputError, match="expected --prune as a share"):
        export([str(tmp_path / "run"), "--format", "ply", "--prune", "2"])
