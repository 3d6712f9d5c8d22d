"""A trained run written out, read back and drawn: the same picture, in the capture's own frame."""

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.files.anchors.compact import read_compact
from scene_experts.files.anchors.layout import read_scaffold_folder
from scene_experts.files.export import export_run, import_result, psnr_cost, world_of, write_compact_run, write_layout
from scene_experts.files.ply import read_anchor_ply
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.training import run_folder
from scene_experts.training.config import Data, RunConfig, Train
from scene_experts.training.loop import Run, train
from support.synthetic import make_capture

STEPS = 25


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=10).folder


def trained(recipe: str, folder: Path, out: Path) -> run_folder.OpenRun:
    """A short run that has passed its warm-up, written out as `train` does; the distance is an input so that units show."""
    base = with_extras(recipe)
    cfg = replace(base, iterations=300, scene=replace(base.scene, add_dist=("color", "cov")))
    config = RunConfig(cfg, Data(folder), stop_at=STEPS)
    run_folder.prepare(out, config, resume=False)
    capture = run_folder.load_capture(config.data)
    for _ in train(cfg, Run(config, out=out), capture, choose("auto", "cpu")):
        pass
    opened = run_folder.open_run(out)
    write_layout(opened, capture)
    capture.images.close()
    return opened


def with_extras(recipe: str) -> Train:
    """The recipe's configuration; a name ending in "+" adds a feature bank and appearance codes."""
    cfg = RECIPES[recipe.rstrip("+")][1]
    return replace(cfg, scene=replace(cfg.scene, mix=FeatureBank(), appearance=8)) if recipe.endswith("+") else cfg


@pytest.fixture(scope="module", params=["scaffold-gs", "moe-gs", "scaffold-gs+", "moe-gs+", "octree-gs"])
def run(request, folder, tmp_path_factory) -> run_folder.OpenRun:
    return trained(request.param, folder, tmp_path_factory.mktemp(request.param))


def picture(run, capture):
    scene, rasterize = run.scene, choose("auto", "cpu")
    camera = capture.views[capture.test[0]].camera
    with torch.no_grad():
        decoded = scene(camera, run.step, Mode.DRAW, rasterize.visible)
        return rasterize(decoded.gaussians, camera, torch.tensor(capture.background)).image


def test_the_layout_is_in_the_input_frame(run, folder):
    capture = run_folder.load_capture(run.config.data)
    world = capture.world
    assert not world.identity and world_of(run) == world
    layout = run.path / "point_cloud" / f"iteration_{STEPS}"
    found = read_anchor_ply(layout / "point_cloud.ply")
    xyz = run.scene.table.facts["xyz"]
    torch.testing.assert_close(found["xyz"], world.to_input(xyz.double()).float())
    torch.testing.assert_close(found["log_scaling"].exp() * world.scale, run.scene.table.params["log_scaling"].detach().exp())
    entries = json.loads((run.path / "cameras.json").read_text())
    assert len(entries) == len(capture.views)
    first = capture.views[capture.test[0]]
    position = world.to_input(first.camera.position.double())
    torch.testing.assert_close(torch.tensor(entries[0]["position"]).double(), position, rtol=1e-5, atol=1e-5)
    assert entries[0]["img_name"] == str(Path(first.name).with_suffix(""))
    sidecar = json.loads((layout / "scene.json").read_text())
    assert str(folder) not in json.dumps(sidecar), "no path of this machine leaves the project"
    assert sidecar["add_dist"] == {"opacity": False, "cov": True, "color": True}
    assert sidecar["phase"]["cov"] == ("sparse" if run.config.train.recipe == "moe-gs" else "single")


def test_the_distance_column_is_in_the_input_unit(run):
    networks = read_scaffold_folder(run.path)[1]
    world = world_of(run)
    trained_w1 = run.scene.network_tensors()["color.w1"].detach()
    torch.testing.assert_close(networks["color"]["w1"][..., 35], trained_w1[..., 35] * world.scale)
    others = [i for i in range(trained_w1.shape[2]) if i != 35]
    assert torch.equal(networks["color"]["w1"][..., others], trained_w1[..., others])
    assert torch.equal(networks["opacity"]["w1"], run.scene.network_tensors()["opacity.w1"].detach())


def packable(run) -> None:
    if hasattr(run.scene.select, "lattices"):
        pytest.skip("levels of detail have no compact form")


@pytest.mark.parametrize("form", ["anchors", "compact"])
def test_written_and_read_back_it_draws_the_same_picture(run, tmp_path, form):
    if form == "compact":
        packable(run)
    target = tmp_path / "out" if form == "anchors" else tmp_path / "file"
    lines = export_run(run.path, form, target)
    assert str(target) in lines[0] and "anchors" in lines[1]
    back = import_result(target, Data(run.config.data.path), tmp_path / "back")
    again = run_folder.open_run(back)
    assert again.cfg == run.cfg and again.step == run.step and again.scene.voxel == run.scene.voxel
    rows = lambda s: sorted(map(tuple, s.table.facts["xyz"].tolist()))  # noqa: E731
    assert rows(again.scene) == rows(run.scene), "positions bit for bit"
    capture = run_folder.load_capture(again.config.data)
    a, b = picture(run, capture), picture(again, capture)
    torch.testing.assert_close(b, a, rtol=0, atol=1e-4 if form == "anchors" else 0.02)
    assert (a - b).abs().mean() < (1e-6 if form == "anchors" else 1e-3)
    capture.images.close()


def test_a_folder_of_another_name_keeps_its_step(run, tmp_path):
    """Experts are drawn by the step: all of them at its beginning."""
    (tmp_path / "shared").symlink_to(run.path / "point_cloud" / f"iteration_{STEPS}")
    back = import_result(tmp_path / "shared", Data(run.config.data.path), tmp_path / "back")
    assert run_folder.open_run(back).step == STEPS


def test_the_cost_of_the_compact_file_is_measured_and_small(run, tmp_path):
    packable(run)
    lines = export_run(run.path, "compact", tmp_path / "file", rasterize=choose("auto", "cpu"))
    before, after, change = (float(x) for x in re.search(r"views ([\d.]+) dB.* ([\d.]+) dB \(([-+][\d.]+)\)", lines[2]).groups())
    assert change == pytest.approx(after - before, abs=0.0011) and abs(change) < 0.05
    capture = run_folder.load_capture(run.config.data)
    assert psnr_cost(run, capture, tmp_path / "file", choose("auto", "cpu"))[0] == pytest.approx(before, abs=6e-4)
    assert float(re.search(r"([\d.]+) bytes an anchor", lines[1])[1]) < 150


def test_defaults_lie_in_the_run_folder(run):
    packable(run)
    assert export_run(run.path, "compact")[0] == f"wrote {run.path / 'scene.compact'}"
    assert read_compact(run.path / "scene.compact").sidecar["recipe"] == run.config.train.recipe
    assert export_run(run.path, "anchors")[0].endswith(f"iteration_{STEPS}")


def test_the_world_without_an_earlier_export_comes_from_the_capture(folder, tmp_path):
    opened = trained("scaffold-gs", folder, tmp_path / "run")
    wanted = world_of(opened)
    for path in (tmp_path / "run" / "point_cloud").rglob("scene.json"):
        value = json.loads(path.read_text())
        value["world"]["scale"] = 77.0
        path.write_text(json.dumps(value))
    assert world_of(opened).scale == 77.0
    value["data"]["split"] = "first:3"  # of a run that was overwritten
    path.write_text(json.dumps(value))
    assert world_of(opened) == wanted
    path.write_text("{torn")
    assert world_of(opened) == wanted


def test_another_capture_gives_no_world_and_a_catalogs_name_is_understood(folder, tmp_path, monkeypatch):
    opened = trained("scaffold-gs", folder, tmp_path / "run")
    for path in (tmp_path / "run" / "point_cloud").rglob("scene.json"):
        path.unlink()  # as in a run that was interrupted
    other = make_capture(tmp_path / "other", views=9).folder
    for form in ("anchors", "compact"):
        with pytest.raises(InputError, match="--data"):
            export_run(opened.path, form, tmp_path / form, data=other)
    assert not (tmp_path / "anchors").exists() and not (tmp_path / "compact").exists()
    (tmp_path / "captures" / "tandt").mkdir(parents=True)
    (tmp_path / "captures" / "tandt" / "truck").symlink_to(folder)
    monkeypatch.setenv("SCENE_EXPERTS_CAPTURES", str(tmp_path / "captures"))
    lines = export_run(opened.path, "compact", tmp_path / "file", rasterize=choose("auto", "cpu"), data=Path("catalog:truck"))
    assert "PSNR of 2 held-out views" in lines[2]


def test_anchors_off_the_lattice_cannot_be_packed(run, tmp_path):
    packable(run)
    opened = run_folder.open_run(run.path)
    opened.scene.table.facts["xyz"] = opened.scene.table.facts["xyz"] + 0.4 * opened.scene.voxel
    with pytest.raises(InputError, match="--format anchors"):
        write_compact_run(opened, world_of(opened), tmp_path / "file")


def test_levels_of_detail_are_written_with_their_columns_and_not_packed(folder, tmp_path):
    opened = trained("octree-moe-gs", folder, tmp_path / "run")
    with pytest.raises(InputError, match="--format anchors"):
        export_run(opened.path, "compact")
    path = opened.path / "point_cloud" / f"iteration_{STEPS}" / "point_cloud.ply"
    found, scale = read_anchor_ply(path), world_of(opened).scale
    levels, facts = opened.scene.select.lattices, opened.scene.table.facts
    assert torch.equal(found["level"], facts["level"]) and torch.equal(found["extra_level"], facts["extra_level"])
    assert found["info"][:3].tolist() == pytest.approx([levels.edge / scale, levels.standard / scale, 0.0])
    assert path.stat().st_size - 316 * len(facts["level"]) < 4000  # 316 bytes an anchor and a header
