"""Runs to files of every format: read back and drawn, they give the same picture; baked, what their description says."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.evaluate.metrics import psnr
from scene_experts.files import registry
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.read import read_anchors, read_folder
from scene_experts.files.export import Options, export, export_several, file_path, result_warnings, world_of, write_result_folder
from scene_experts.files.gaussians.read import DRAWN_AT, scene_of, table_columns
from scene_experts.files.gaussians.write import splats_of
from scene_experts.files.importing import import_files
from scene_experts.files.measure import Painter
from scene_experts.files.registry import GAUSSIANS, format_named, formats_of
from scene_experts.files.result_folder import read_settings
from scene_experts.render import choose
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.loop import Run, train
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training
from support.files import export_run
from support.messages import naming
from support.synthetic import make_capture
from support.trainings import start_changed

STEPS = 25


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    return make_capture(tmp_path_factory.mktemp("capture"), views=10).folder


def trained(recipe: str, folder: Path, out: Path) -> run_folder.OpenRun:
    """A short run that has passed its warm-up, written out as `train` does; the distance is an input so that units show. No two depths are
    equal, or rounding would decide the order of drawing."""
    base = with_extras(recipe)
    cfg = replace(base, iterations=300, scene=replace(base.scene, add_dist=("color", "cov")))
    config = RunConfig(cfg, Data(folder), stop_at=STEPS)
    run_folder.prepare(out, config, resume=False)
    capture = run_folder.load_capture(config.data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Training, "start", partial(start_changed, change=1e-3))
        list(train(cfg, Run(config, out=out), capture, choose("auto", "cpu")))
    opened = run_folder.open_run(out)
    write_result_folder(opened, capture)
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
    found = read_anchors(layout / "point_cloud.ply")
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


def test_the_original_tools_find_every_setting_that_they_read(run, folder):
    settings = read_settings(run.path / "point_cloud" / f"iteration_{STEPS}")
    published = "sh_degree feat_dim n_offsets voxel_size update_depth update_init_factor update_hierachy_factor use_feat_bank source_path"
    published += " images resolution white_background data_device eval lod appearance_dim ratio"
    assert {*published.split(), "add_opacity_dist", "add_cov_dist", "add_color_dist"} == settings.keys()
    assert settings["source_path"] == str(folder) and settings["ratio"] == 1 and settings["n_offsets"] == run.scene.K
    assert [settings[name] for name in ("update_depth", "update_init_factor", "update_hierachy_factor")] == [3, 16, 4]


def test_the_distance_column_is_in_the_input_unit(run):
    networks = read_folder(run.path / "point_cloud" / f"iteration_{STEPS}").networks
    world = world_of(run)
    trained_w1 = run.scene.network_tensors()["color.w1"].detach()
    torch.testing.assert_close(networks["color.experts.w1"][..., 35], trained_w1[..., 35] * world.scale)
    others = [i for i in range(trained_w1.shape[2]) if i != 35]
    assert torch.equal(networks["color.experts.w1"][..., others], trained_w1[..., others])
    assert torch.equal(networks["opacity.experts.w1"], run.scene.network_tensors()["opacity.w1"].detach())


def packable(run) -> None:
    if run.scene.traits.levels:
        pytest.skip("levels of detail have no compact form")


@pytest.mark.parametrize("form", ["anchors", "compact"])
def test_written_and_read_back_it_draws_the_same_picture(run, tmp_path, form):
    if form == "compact":
        packable(run)
    target = tmp_path / "out" if form == "anchors" else tmp_path / "file.compact"
    (written,) = export_run(run.path, form, target)
    assert str(target) in written.lines[0] and "anchors" in written.lines[1] and written.rows == len(run.scene.positions)
    assert written.path.is_relative_to(target) and written.bytes > 1000
    back = import_files(target, Data(run.config.data.path), tmp_path / "back")
    again = run_folder.open_run(back)
    assert again.config.train == run.config.train and again.step == run.step and again.scene.voxel == run.scene.voxel
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
    back = import_files(tmp_path / "shared", Data(run.config.data.path), tmp_path / "back")
    assert run_folder.open_run(back).step == STEPS


def test_the_cost_of_the_compact_file_is_measured_and_small(run, tmp_path):
    packable(run)
    (written,) = export_run(run.path, "compact", tmp_path / "file.compact", measure=True)
    before, after = written.psnr["run"], written.psnr["file"]
    assert abs(after - before) < 0.05 and f"{before:.3f} dB" in written.lines[-1] and f"{after:.3f} dB" in written.lines[-1]
    capture, total = run_folder.load_capture(run.config.data), 0.0
    for index in capture.test:
        painter = Painter.of(run.scene, run.step, choose("auto", "cpu"))
        with torch.no_grad():
            image = painter.picture_8bit(capture.views[index].camera, torch.tensor(capture.background))
        total += psnr(image, capture.frame(index).rgb.float() / 255) / len(capture.test)
    capture.images.close()
    assert total == pytest.approx(before, abs=1e-5)
    assert "bytes" in written.lines[1]


def test_defaults_lie_in_the_run_folder(run):
    packable(run)
    assert export_run(run.path, "compact")[0].path == run.path / "scene.compact"
    assert compact.read(run.path / "scene.compact").about["recipe"] == run.config.train.recipe
    assert export_run(run.path, "anchors")[0].path == run.path / "point_cloud" / f"iteration_{STEPS}"


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
    (written,) = export_run(opened.path, "compact", tmp_path / "file.compact", data=Path("catalog:truck"), measure=True)
    assert "PSNR" in written.lines[2]


def test_anchors_off_the_lattice_cannot_be_packed(run, tmp_path):
    packable(run)
    opened = run_folder.open_run(run.path)
    opened.scene.table.facts["xyz"] = opened.scene.positions + 0.4 * opened.scene.voxel
    with pytest.raises(InputError, match="--format anchors"):
        export(opened, "compact", tmp_path / "file.compact")


def test_levels_of_detail_are_written_with_their_columns_and_not_packed(folder, tmp_path):
    opened = trained("octree-moe-gs", folder, tmp_path / "run")
    with pytest.raises(InputError, match="--format anchors"):
        export_run(opened.path, "compact")
    path = opened.path / "point_cloud" / f"iteration_{STEPS}" / "point_cloud.ply"
    found, scale = read_anchors(path), world_of(opened).scale
    levels, facts = opened.scene.select.lattices, opened.scene.table.facts
    assert torch.equal(found["level"], facts["level"]) and torch.equal(found["extra_level"], facts["extra_level"])
    assert found["info"][:3].tolist() == pytest.approx([levels.edge / scale, levels.standard / scale, 0.0])
    assert path.stat().st_size - 316 * len(facts["level"]) < 4000  # 316 bytes an anchor and a header


# --- standard Gaussians -------------------------------------------------------------------------------------------------------------------

SHORT = {"sh_degree": 1, "refine": 5}


def short_run(recipe: str, root: Path) -> Path:
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=250, scale=3.0).folder
    config = RunConfig(replace(RECIPES[recipe][1], iterations=300), Data(folder), stop_at=20)
    run_folder.prepare(root / "run", config, resume=False)
    capture = run_folder.load_capture(config.data)
    list(train(config.train, Run(config, root / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    return root / "run"


@pytest.fixture(scope="module", params=["moe-gs", "sags", "3dgs"])
def short(request, tmp_path_factory) -> Path:
    return short_run(request.param, tmp_path_factory.mktemp(request.param))


def measured(short: Path, file: Path, world: World | None = None) -> float:
    """PSNR of the held-out views as our own renderer draws the file."""
    opened = run_folder.open_run(short)
    capture, draw, total = run_folder.load_capture(opened.config.data), choose("auto", "cpu"), 0.0
    scene = scene_of(table_columns(registry.read(file), world or capture.world), capture.extent)
    painter = Painter.of(scene, DRAWN_AT, draw)
    with torch.no_grad():
        for index in capture.test:
            image = painter.picture_8bit(capture.views[index].camera, torch.tensor(capture.background))
            total += psnr(image, capture.frame(index).rgb.float() / 255)
    capture.images.close()
    return total / len(capture.test)


def test_what_is_printed_is_what_the_file_gives(short, tmp_path):
    said = []
    opened, options = run_folder.open_run(short), Options(**SHORT)
    tell = lambda *what: said.append(what[0])  # noqa: E731
    (written,) = export(opened, "ply", tmp_path / "a.ply", options, tell=tell, command="scene-experts export RUN")
    lines = written.lines
    about = json.loads((tmp_path / "a.ply.json").read_text())
    assert lines[0] == f"wrote {tmp_path / 'a.ply'}" and "held-out views" in lines[2]
    assert f"{about['psnr']['file']['photographs']:.3f} dB" in lines[2]
    assert measured(short, tmp_path / "a.ply") == pytest.approx(about["psnr"]["file"]["photographs"], abs=2e-5)
    assert about["gaussians"] == len(registry.read(tmp_path / "a.ply")) > 50 and about["command"] == "scene-experts export RUN"
    assert about["bytes"] == (tmp_path / "a.ply").stat().st_size and about["frame"] == "capture"
    assert about["sh_degree"] == 1 and about["bake"]["refine"]["iterations"] == 5
    assert {"run", "closed_form", "bake", "file", "views"} == set(about["psnr"]) and "refining" in said


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_several_formats_share_one_bake(short, tmp_path):
    said = []
    opened, options = run_folder.open_run(short), Options(measure=False, sh_degree=1, refine=0, floaters="remove", crop="sphere:3x")
    tell = lambda what, done, total: said.append(what) if done == total else None  # noqa: E731
    written = export_several(opened, ("ply", "spz", "compact"), tmp_path / "all", replace(options, floaters="keep", crop=None), tell=tell)
    assert len(written) == 3
    assert said.count("summing contributions") == 1 and "same bake" in " ".join(line for w in written for line in w.lines)
    (one,) = export(opened, "ply", tmp_path / "one.ply", replace(options, floaters="keep", crop=None))
    assert one.path.read_bytes() == (tmp_path / "all" / "scene.ply").read_bytes()
    chosen = export_several(opened, ("ply", "spz"), tmp_path / "some", options, tell=tell)
    assert said.count("finding floaters") == 1 and "sphere:3x" in " ".join(chosen[1].lines) and chosen[0].rows <= one.rows
    about = json.loads((tmp_path / "some" / "scene.spz.json").read_text())
    assert about["crop"] == "sphere:3x" and about["floaters"] >= 0
    with pytest.raises(InputError, match="--out"):
        export_several(opened, ("ply", "spz"), tmp_path / "a.ply", options)


@pytest.mark.parametrize("short", ["moe-gs", "3dgs"], indirect=True)
def test_frames_and_folders(short, tmp_path):
    export_run(short, "ply", tmp_path, refine=0)
    (written,) = export_run(short, "ply", tmp_path / "world.ply", refine=0, frame="trained")
    assert len(written.lines) == 2 and written.psnr == {}
    opened = run_folder.open_run(short)
    capture = run_folder.load_capture(opened.config.data)
    capture.images.close()
    own, world = registry.read(tmp_path / "scene.ply"), registry.read(tmp_path / "world.ply")
    assert capture.world.scale != 1 and own.degree == 3
    torch.testing.assert_close(capture.world.from_input(own.means.double()).float(), world.means, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(own.log_scales + math.log(capture.world.scale), world.log_scales, rtol=1e-4, atol=1e-4)
    assert measured(short, tmp_path / "world.ply", World()) == pytest.approx(measured(short, tmp_path / "scene.ply"), abs=0.01)


@pytest.mark.parametrize("short", ["3dgs"], indirect=True)
def test_what_a_format_cannot_hold_is_told(short, tmp_path):
    opened = run_folder.open_run(short)
    with torch.no_grad():
        opened.scene.table.params["log_scales"] += 20
    (spz,), (sog,) = (export(opened, name, tmp_path, Options(measure=False)) for name in ("spz", "sog"))
    assert spz.lines[-1].startswith("warning: ") and "SPZ" in spz.lines[-1] and not any("warning" in line for line in sog.lines)


@pytest.mark.parametrize("short", ["3dgs"], indirect=True)
@pytest.mark.parametrize("prune", [0.0, 0.02])
def test_what_is_said_of_the_harmonics_is_what_the_file_holds(short, tmp_path, prune):
    (written,) = export_run(short, "splat", tmp_path / "a.splat", prune=prune, refine=0)
    about = json.loads((tmp_path / "a.splat.json").read_text())
    assert about["sh_degree"] == registry.read(written.path).degree == 0 and "degree 0" in written.lines[1]
    assert not prune or about["bake"]["sh_degree"] == 0  # colours are fitted for what the file holds


@pytest.mark.slow
@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_each_format_is_measured_from_its_own_file(short, tmp_path):
    for format, of in formats_of(GAUSSIANS).items():
        path = tmp_path / f"scene{of.suffix}"
        export_run(short, format, path, sh_degree=1, refine=0, measure=True)
        about = json.loads(path.with_name(path.name + ".json").read_text())
        assert measured(short, path) == pytest.approx(about["psnr"]["file"]["photographs"], abs=2e-5), format
        assert about["sh_degree"] == (0 if format == "splat" else 1)


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_what_cannot_be_is_refused_in_one_sentence(short, tmp_path):
    with pytest.raises(InputError, match=naming("obj", "ply")):
        export_run(short, "obj")
    file = tmp_path / "x.ply"
    wrong = {"levels": True, "sh_degree": 5, "max_gaussians": -1, "refine": -1, "prune": 1.0}
    for name, value in wrong.items():
        with pytest.raises(InputError, match="--" + name.replace("_", "-")):
            export_run(short, "ply", file, **{name: value})
    with pytest.raises(InputError, match=naming("gone", "--data")):
        export_run(short, "ply", file, data=tmp_path / "gone", **SHORT)
    other = make_capture(tmp_path / "other", views=10, size=(48, 32), points=50).folder
    with pytest.raises(InputError, match="--data"):
        export_run(short, "ply", file, data=other, **SHORT)
    assert not file.exists()


def test_the_name_of_a_file_may_not_say_another_format(tmp_path):
    ply, compressed = format_named("ply"), format_named("compressed-ply")
    assert file_path(tmp_path, "ply", ply, None) == tmp_path / "scene.ply" == file_path(Path("run"), "ply", ply, tmp_path)
    for name in ("a.PLY", "a.compressed.ply"):
        assert file_path(tmp_path, "compressed-ply", compressed, tmp_path / name) == tmp_path / name
    for name in ("a.spz", "a.compressed.ply", "a.bin", "a.v2"):
        with pytest.raises(InputError, match=naming(name, ".ply")):
            file_path(tmp_path, "ply", ply, tmp_path / name)
    usd, glb = format_named("usd"), format_named("glb")
    for name in ("a.usdc", "a.usda", "a.USD"):
        assert file_path(tmp_path, "usd", usd, tmp_path / name) == tmp_path / name
    for format, name in (("usd", "a.usdz"), ("glb", "a.gltf")):
        with pytest.raises(InputError, match=naming(name, f"--format {format}")):
            file_path(tmp_path, format, {"usd": usd, "glb": glb}[format], tmp_path / name)


def test_a_name_without_a_suffix_is_a_folder(tmp_path):
    ply, spz = format_named("ply"), format_named("spz")
    (tmp_path / "made.v2").mkdir()
    for name in ("new", "new/deeper", "made.v2"):
        assert file_path(tmp_path, "ply", ply, tmp_path / name) == tmp_path / name / "scene.ply"
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(InputError, match=naming("taken", "folder")):
        file_path(tmp_path, "spz", spz, tmp_path / "taken")


def test_a_family_without_files_leaves_its_cameras_and_can_be_baked(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(registry, "FAMILIES", {GAUSSIANS: registry.FAMILIES[GAUSSIANS]})
    opened = trained("scaffold-gs", folder, tmp_path / "run")
    assert (opened.path / "cameras.json").is_file() and not (opened.path / "point_cloud").exists() and result_warnings(opened) == []
    with pytest.raises(InputError, match="--format ply"):
        export(opened, "compact")
    assert export(opened, "ply", options=Options(False, refine=0))[0].path.is_file()


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_a_capture_that_moved_is_found_by_its_flag(short, tmp_path):
    data = run_folder.read_config(short).data.path
    (tmp_path / "moved").symlink_to(data)
    (written,) = export_run(short, "ply", tmp_path / "x.ply", data=tmp_path / "moved", measure=True, **SHORT)
    assert "held-out views" in written.lines[2]


@pytest.mark.parametrize("short", ["3dgs"], indirect=True)
def test_plain_gaussians_need_no_capture(short, tmp_path):
    opened = run_folder.open_run(short)
    capture = run_folder.load_capture(opened.config.data)
    capture.images.close()
    write_result_folder(opened, capture)
    (written,) = export_run(short, "ply", tmp_path / "x.ply", data=tmp_path / "gone", measure=True)
    assert "held-out" not in written.lines[2] and "--data" in written.lines[2]
    torch.testing.assert_close(registry.read(tmp_path / "x.ply").means, splats_of(opened.scene, capture.world).means)


@pytest.mark.slow
def test_levels_of_detail_become_one_file_each(tmp_path):
    short = short_run("octree-gs", tmp_path)
    scene = run_folder.open_run(short).scene
    files = export_run(short, "ply", tmp_path / "out.ply", sh_degree=1, refine=0, levels=True)
    count = sum(rows > 0 for rows in scene.rows_by_level())
    assert sorted(tmp_path.glob("out_level*.ply")) == [file.path for file in files] and len(files) == count > 1
    sizes = [file.rows for file in files]
    assert sizes == sorted(set(sizes))  # a level without anchors gets no file
    assert json.loads((tmp_path / "out_level1.ply.json").read_text())["level"] == 1
    assert export_run(short, "ply", tmp_path / "bare", refine=0, levels=True)[0].path == tmp_path / "bare" / "scene_level0.ply"
