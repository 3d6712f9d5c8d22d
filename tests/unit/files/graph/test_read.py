"""Graph points out and in again: the same run, whatever the capture's unit; SAGS's own files are refused in a sentence."""

import json

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.data.settings import Data
from scene_experts.files.formats.ply import read_vertices, write_vertices
from scene_experts.files.graph import read as graph_reader
from scene_experts.files.importing import import_files
from scene_experts.render import choose
from scene_experts.training import run_folder
from support.messages import naming


def test_a_run_comes_back_from_its_files(made, tmp_path):
    run, _, capture = made
    again = run_folder.open_run(import_files(run, Data(capture.root), tmp_path / "again"))
    first, draw = run_folder.open_run(run), choose("auto", "cpu", deterministic=True)
    assert again.step == first.step and again.config.train == first.config.train
    for name in ("cell", "xyz"):
        assert torch.equal(again.scene.table.facts[name], first.scene.table.facts[name]), name
    assert torch.equal(again.scene.table.params["feature"], first.scene.table.params["feature"])
    old, new = first.scene.meta(), again.scene.meta()
    assert old.keys() == new.keys() and all(new[k] == pytest.approx(old[k], rel=1e-6) for k in old)
    camera = capture.views[capture.test[0]].camera
    with torch.no_grad():
        pictures = [
            draw(s(camera, 60, Mode.DRAW, draw.visible).gaussians, camera, torch.zeros(3)).image for s in (first.scene, again.scene)
        ]
    torch.testing.assert_close(pictures[0], pictures[1], atol=2e-4, rtol=0)
    assert (tmp_path / "again" / "point_cloud" / "iteration_60" / "networks.safetensors").is_file()


def test_what_does_not_fit_is_told(made, tmp_path):
    run, folder, capture = made
    with pytest.raises(InputError, match="--normalise"):
        import_files(run, Data(capture.root, normalise="none"), tmp_path / "other")
    published = tmp_path / "published"
    published.mkdir()
    (published / "point_cloud.ply").write_bytes((folder / "point_cloud.ply").read_bytes())
    with pytest.raises(InputError, match=naming(published)):
        import_files(published, Data(capture.root), tmp_path / "theirs")
    (published / "scene.json").write_bytes((folder / "scene.json").read_bytes())
    with pytest.raises(InputError, match=naming(published / "networks.safetensors")):
        import_files(published, Data(capture.root), tmp_path / "theirs")
    (published / "networks.safetensors").write_bytes((folder / "networks.safetensors").read_bytes())
    whole = read_vertices(folder / "point_cloud.ply")
    write_vertices(published / "point_cloud.ply", {name: column for name, column in whole.items() if name not in ("x", "scale_5")})
    with pytest.raises(InputError, match=naming("point_cloud.ply", "x, scale_5")):
        import_files(published, Data(capture.root), tmp_path / "theirs")
    about = json.loads((published / "scene.json").read_text())
    (published / "scene.json").write_text(json.dumps({k: v for k, v in about.items() if k not in ("grid", "step")}))
    with pytest.raises(InputError, match=naming("scene.json", "grid, step")):
        import_files(published, Data(capture.root), tmp_path / "theirs")
    (published / "scene.json").write_text(json.dumps(about | {"kind": "anchors"}))
    assert graph_reader.find(published, None) is None
