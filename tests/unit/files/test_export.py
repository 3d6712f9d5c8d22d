"""Runs to files of every format: read back and drawn, they give the same picture; baked, what their description says."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch

from scene_experts.cli import main
from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.evaluate.metrics import psnr
from scene_experts.files import registry
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.read import read_anchors, read_folder
from scene_experts.files.export import Options, export, export_several, file_path
from scene_experts.files.importing import import_files
from scene_experts.files.measure import Painter
from scene_experts.files.registry import GAUSSIANS, format_named
from scene_experts.files.result_folder import read_settings
from scene_experts.files.scene_folder import result_warnings, world_of, write_result_folder
from scene_experts.render import choose
from scene_experts.scene.anchors.features import FeatureBank
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.job import Job
from scene_experts.training.loop import train
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
    capture = captures.load(config.data)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Training, "start", partial(start_changed, change=1e-3))
        list(train(cfg, Job(config, out=out), capture, choose("auto", "cpu")))
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
    capture = captures.load(run.config.data)
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


@pytest.mark.parametrize("form", ["anchors", "compact"])
def test_written_and_read_back_it_draws_the_same_picture(run, tmp_path, form):
    target = tmp_path / "out" if form == "anchors" else tmp_path / "file.compact"
    (written,) = export_run(run.path, form, target, **({"quality": 1e-4} if form == "compact" else {}))
    assert str(target) in written.lines[0] and "anchors" in written.lines[1] and written.rows == len(run.scene.positions)
    assert written.path.is_relative_to(target) and written.bytes > 1000
    back = import_files(target, Data(run.config.data.path), tmp_path / "back")
    again = run_folder.open_run(back)
    assert again.config.train == run.config.train and again.step == run.step and again.scene.voxel == run.scene.voxel
    rows = lambda s: sorted(map(tuple, s.table.facts["xyz"].tolist()))  # noqa: E731
    assert rows(again.scene) == rows(run.scene), "positions bit for bit"
    capture = captures.load(again.config.data)
    a, b = picture(run, capture), picture(again, capture)
    torch.testing.assert_close(b, a, rtol=0, atol=1e-4 if form == "anchors" else 0.02)
    assert (a - b).abs().mean() < (1e-6 if form == "anchors" else 1e-3)
    capture.images.close()


def test_a_list_of_cameras_of_something_else_stays(run, tmp_path):
    own = tmp_path / "cameras.json"
    own.write_text("[]")
    with pytest.raises(InputError, match=r"no cameras\.json in .* name another folder"):
        export_run(run.path, "anchors", tmp_path)
    assert own.read_text() == "[]" and not (tmp_path / "point_cloud").exists()
    export_run(run.path, "anchors", tmp_path / "new")
    export_run(run.path, "anchors", tmp_path / "new")  # its own are replaced


def test_a_folder_of_another_name_keeps_its_step(run, tmp_path):
    """Experts are drawn by the step: all of them at its beginning."""
    (tmp_path / "shared").symlink_to(run.path / "point_cloud" / f"iteration_{STEPS}")
    back = import_files(tmp_path / "shared", Data(run.config.data.path), tmp_path / "back")
    assert run_folder.open_run(back).step == STEPS


def test_the_cost_of_the_compact_file_is_measured_and_small(run, tmp_path):
    (written,) = export_run(run.path, "compact", tmp_path / "file.compact", measure=True, quality=0.01)
    before, after = written.psnr["run"], written.psnr["file"]
    assert abs(after - before) < 0.05 and f"{before:.3f} dB" in written.lines[-1] and f"{after:.3f} dB" in written.lines[-1]
    capture, total = captures.load(run.config.data), 0.0
    for index in capture.test:
        painter = Painter.of(run.scene, run.step, choose("auto", "cpu"))
        with torch.no_grad():
            image = painter.picture_8bit(capture.views[index].camera, torch.tensor(capture.background))
        total += psnr(image, capture.frame(index).rgb.float() / 255) / len(capture.test)
    capture.images.close()
    assert total == pytest.approx(before, abs=1e-5)
    assert "bytes" in written.lines[1]


@pytest.mark.slow
def test_a_live_page_knows_the_photographs_places_with_and_without_them(tmp_path):
    data = make_capture(tmp_path / "capture", views=10).folder
    opened = trained("octree-gs", data, tmp_path / "run")
    settings = lambda path: json.loads(path.read_text().split('id="settings">')[1].split("</script>")[0])  # noqa: E731
    (written,) = export_run(opened.path, "html", title="Our <garden>", measure=True)
    assert written.path == opened.path / "scene.html" and "<title>Our &lt;garden&gt;</title>" in written.path.read_text()
    assert "PSNR" in written.lines[-1] and abs(written.psnr["file"] - written.psnr["run"]) < 0.5
    found = settings(written.path)
    near = captures.load(opened.config.data).views[0].camera.near / world_of(opened).scale
    assert len(found["poses"]) == 10 and found["reach"] > 0 and found["nearest"] == pytest.approx(near)
    assert found["heads"]["cov"]["distance"] == 2.0 ** round(math.log2(world_of(opened).scale)) and found["levels"]["rule"] == "round"
    data.rename(tmp_path / "elsewhere")
    again = settings(export_run(opened.path, "html", tmp_path / "a.html")[0].path)
    assert len(again["poses"]) == 10  # those of cameras.json
    (opened.path / "cameras.json").unlink()
    around = settings(export_run(opened.path, "html", tmp_path / "b.html")[0].path)
    assert len(around["poses"]) == 1 and around["reach"] is None  # nothing was photographed from there
    with pytest.raises(InputError, match=naming("--refine", "html")):
        export_run(opened.path, "html", refine=3)
    with pytest.raises(InputError, match=naming("--title", "compact")):
        export_run(opened.path, "compact", title="a")
    with pytest.raises(InputError, match=naming("--photographs", "--data")):
        export_run(opened.path, "html", photographs=True)  # the capture moved, and cameras.json is gone
    for name in ("compact", "ply"):
        with pytest.raises(InputError, match=naming("--photographs", "html", f"found {name}")):
            export_run(opened.path, name, photographs=True)


def test_defaults_lie_in_the_run_folder(run):
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
    assert "PSNR" in written.lines[-1]


def test_anchors_off_the_lattice_cannot_be_packed(run, tmp_path):
    opened = run_folder.open_run(run.path)
    opened.scene.table.facts["xyz"] = opened.scene.positions + 0.4 * opened.scene.voxel
    with pytest.raises(InputError, match="--format anchors"):
        export(opened, "compact", tmp_path / "file.compact")


def test_levels_of_detail_are_written_with_their_columns(folder, tmp_path):
    opened = trained("octree-moe-gs", folder, tmp_path / "run")
    path = opened.path / "point_cloud" / f"iteration_{STEPS}" / "point_cloud.ply"
    found, scale = read_anchors(path), world_of(opened).scale
    levels, facts = opened.scene.select.lattices, opened.scene.table.facts
    assert torch.equal(found["level"], facts["level"]) and torch.equal(found["extra_level"], facts["extra_level"])
    assert found["info"][:3].tolist() == pytest.approx([levels.edge / scale, levels.standard / scale, 0.0])
    assert path.stat().st_size - 316 * len(facts["level"]) < 4000  # 316 bytes an anchor and a header


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


def test_a_page_is_baked_where_its_script_cannot_decode_the_scene(tmp_path):
    data, found = make_capture(tmp_path / "capture", views=5, size=(24, 16), points=60).folder, {}
    words = ["--data", str(data), "--iterations", "20", "--device", "cpu", "--preview-every", "0"]
    for recipe in ("3dgs", "scaffold-gs-bank", "scaffold-gs"):
        assert main(["train", recipe, "--out", str(tmp_path / recipe), *words]) == 0
        (found[recipe],) = export_run(tmp_path / recipe, "html", tmp_path / f"{recipe}.html")
    assert {recipe: registry.recognise(page.path)[0] for recipe, page in found.items()} == {
        "3dgs": "baked-html",
        "scaffold-gs-bank": "baked-html",
        "scaffold-gs": "html",
    }
    said = {recipe: "cannot decode a feature bank" in page.lines[-1] for recipe, page in found.items()}
    assert said == {"3dgs": False, "scaffold-gs-bank": True, "scaffold-gs": False}
    with pytest.raises(InputError, match=naming("html and baked-html")):
        export_several(run_folder.open_run(tmp_path / "scaffold-gs"), ("html", "baked-html"), tmp_path / "out")


def test_the_size_of_a_streamed_page_has_its_parts(tmp_path):
    data = make_capture(tmp_path / "capture", views=5, size=(24, 16), points=60).folder
    words = ["--data", str(data), "--iterations", "5", "--device", "cpu", "--preview-every", "0"]
    assert main(["train", "scaffold-gs", "--out", str(tmp_path / "run"), *words]) == 0
    (written,) = export_run(tmp_path / "run", "streamed-html", tmp_path / "s" / "index.html")
    page, text = written.path.stat().st_size, written.lines[1]
    parts = [part.stat().st_size for part in (tmp_path / "s" / "index.parts").iterdir()]
    assert written.bytes == page + sum(parts)
    assert f"{written.bytes / 1e6:.2f} MB with networks: page {page / 1e6:.2f}, {len(parts)} parts {sum(parts) / 1e6:.2f} in index" in text


def test_a_precision_that_no_format_has_is_refused_at_once(tmp_path):
    data = make_capture(tmp_path / "capture", views=4, size=(24, 16), points=60).folder
    words = ["--data", str(data), "--iterations", "20", "--device", "cpu", "--preview-every", "0"]
    assert main(["train", "scaffold-gs", "--out", str(tmp_path / "run"), *words]) == 0
    for format in ("sog", "baked-html"):
        with pytest.raises(InputError, match=naming("--target-mb", format, "--max-gaussians")):
            export_run(tmp_path / "run", format, tmp_path / "a", target_mb=2.0)
    with pytest.raises(InputError, match=naming("--quality", "mesh")):
        export_run(tmp_path / "run", "mesh", tmp_path / "a", quality=0.5)
    (page,) = export_run(tmp_path / "run", "html", tmp_path / "a.html", target_mb=0.09)
    assert page.bytes <= 90_000


def test_options_that_no_file_has_are_refused_and_a_title_is_kept_beside_other_files(tmp_path):
    data = make_capture(tmp_path / "capture", views=4, size=(24, 16), points=60).folder
    words = ["--data", str(data), "--iterations", "5", "--device", "cpu", "--preview-every", "0"]
    for recipe in ("scaffold-gs", "3dgs"):
        assert main(["train", recipe, "--out", str(tmp_path / recipe), *words]) == 0
    direct = tmp_path / "3dgs"
    for format, options in {"ply": {"cells": 16}, "spz": {"title": "X"}, "splat": {"refine": 300}}.items():
        with pytest.raises(InputError, match=naming(f"--{next(iter(options))}", format)):
            export_run(direct, format, tmp_path / "a", **options)
    with pytest.raises(InputError, match=naming("--cells", "--format mesh")):
        export_run(tmp_path / "scaffold-gs", "compact", tmp_path / "a", cells=16)
    run = run_folder.open_run(tmp_path / "scaffold-gs")
    pages = export_several(run, ("html", "compact", "ply"), tmp_path / "several", Options(title="My title", refine=0, measure=False))
    assert "<title>My title</title>" in next(one.path.read_text() for one in pages if one.path.suffix == ".html")


def test_a_page_takes_the_place_of_another_with_its_description_and_parts(tmp_path):
    data = make_capture(tmp_path / "capture", views=5, size=(24, 16), points=60).folder
    words = ["--data", str(data), "--iterations", "5", "--device", "cpu", "--preview-every", "0"]
    assert main(["train", "scaffold-gs", "--out", str(tmp_path / "run"), *words]) == 0
    page = tmp_path / "page.html"
    export_run(tmp_path / "run", "streamed-html", page)
    parts, note = page.with_suffix(".parts"), page.with_name("page.html.json")
    (parts / "mine.txt").write_text("stays")
    export_run(tmp_path / "run", "baked-html", page, refine=0)
    assert [part.name for part in parts.iterdir()] == ["mine.txt"] and note.is_file()
    export_run(tmp_path / "run", "html", page)
    assert not note.exists()


def test_an_export_of_a_file_is_repeated_over_its_own_but_not_over_other_files(tmp_path):
    data = make_capture(tmp_path / "capture", views=5, size=(24, 16), points=60).folder
    words = ["--data", str(data), "--iterations", "5", "--device", "cpu", "--preview-every", "0"]
    assert main(["train", "scaffold-gs", "--out", str(tmp_path / "run"), *words]) == 0
    export_run(tmp_path / "run", "compact", tmp_path / "garden.compact")
    page = tmp_path / "garden.html"
    for kind in ("html", "html", "streamed-html", "baked-html", "html"):
        assert main(["export", str(tmp_path / "garden.compact"), "--format", kind, *(["--refine", "0"] if "baked" in kind else [])]) == 0
    before = (tmp_path / "garden.compact").read_bytes()
    assert main(["export", str(page), "--format", "compact"]) != 0  # the page may hold less
    assert (tmp_path / "garden.compact").read_bytes() == before
    page.write_text("<!doctype html><title>mine</title>")
    assert main(["export", str(tmp_path / "garden.compact"), "--format", "html"]) != 0
    assert "mine" in page.read_text()
