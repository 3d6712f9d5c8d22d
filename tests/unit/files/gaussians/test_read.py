"""Explicit Gaussians through 3DGS's file and back: the same picture, in the capture's own frame."""

import json
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.types import Mode
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.files import registry
from scene_experts.files.export import export
from scene_experts.files.formats import ply, splat
from scene_experts.files.formats.ply import read_vertices, write_vertices
from scene_experts.files.gaussians.read import noted_origin
from scene_experts.files.importing import import_files
from scene_experts.files.options import Options
from scene_experts.files.result_folder import read_settings
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.render import choose
from scene_experts.training import loop as train
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.files import export_run
from support.messages import naming
from support.splats import splats
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A short training of a capture whose unit is not ours, and its folder."""
    root = tmp_path_factory.mktemp("explicit")
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=300, scale=3.0).folder
    cfg = replace(RECIPES["3dgs"][1], iterations=90)
    config = RunConfig(cfg, Data(folder))
    run_folder.prepare(root / "run", config, resume=False)
    capture = load(folder)
    list(train.train(cfg, train.Job(config, root / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    return root / "run", folder


def to_ply(run, path):
    return export_run(run, "ply", path)[0]


def drawn(run, index=0):
    opened = run_folder.open_run(run)
    capture = captures.load(opened.config.data)
    draw, camera = choose("auto", "cpu"), capture.views[capture.test[index]].camera
    capture.images.close()
    with torch.no_grad():
        return draw(opened.scene(camera, opened.step, Mode.DRAW, draw.visible).gaussians, camera, torch.zeros(3)).image


def test_the_file_has_the_layout_of_3dgs_in_the_frame_of_the_capture(made, tmp_path):
    run, folder = made
    written = to_ply(run, tmp_path / "out.ply")
    columns = read_vertices(tmp_path / "out.ply")
    names = [*"xyz", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), *(f"f_rest_{i}" for i in range(45)), "opacity"]
    assert list(columns) == [*names, *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    assert "Gaussians" in written.lines[1] and all(c.dtype == np.float32 for c in columns.values())
    scene = run_folder.open_run(run).scene
    world = captures.load(Data(folder)).world
    assert world.scale != 1
    xyz = torch.from_numpy(np.stack([columns[a] for a in "xyz"], 1))
    p = scene.table.params
    torch.testing.assert_close(world.from_input(xyz.double()).float(), p["means"].detach(), atol=1e-5, rtol=0)
    torch.testing.assert_close(
        torch.from_numpy(columns["scale_1"].copy()).exp() * world.scale, p["log_scales"].detach()[:, 1].exp(), rtol=1e-5, atol=0
    )
    red = torch.from_numpy(np.stack([columns[f"f_rest_{i}"] for i in range(15)], 1))  # channel by channel
    assert torch.equal(red, p["sh_rest"].detach()[:, :, 0])


def test_a_file_comes_back_as_a_run_that_draws_the_same_picture(made, tmp_path):
    run, folder = made
    to_ply(run, tmp_path / "scene.ply")
    out = import_files(tmp_path / "scene.ply", Data(folder), tmp_path / "again")
    opened = run_folder.open_run(out)
    assert opened.step == 0 and opened.config.train.recipe == "3dgs" and opened.scene.degree(opened.step) == 3
    assert (drawn(out) - drawn(run)).abs().mean() < 1e-4
    assert (out / "cameras.json").is_file() and (out / "point_cloud" / "iteration_0" / "point_cloud.ply").is_file()


def test_our_own_folder_keeps_recipe_and_step(made, tmp_path):
    run, folder = made
    layout = write_result_folder(run_folder.open_run(run), captures.load(Data(folder)), tmp_path / "result")
    settings = read_settings(layout)
    assert layout.name == "iteration_90" and settings["sh_degree"] == 3 and settings["source_path"] == str(folder)
    out = import_files(tmp_path / "result", Data(folder), tmp_path / "again")
    opened = run_folder.open_run(out)
    assert opened.step == 90 and opened.config.train == run_folder.open_run(run).config.train
    assert (drawn(out) - drawn(run)).abs().mean() < 1e-4


@pytest.mark.parametrize("degree", range(3))
def test_files_of_lower_degree_are_read(made, tmp_path, degree):
    run, folder = made
    to_ply(run, tmp_path / "full.ply")
    columns, count = read_vertices(tmp_path / "full.ply"), (degree + 1) ** 2 - 1
    rest = [f"f_rest_{15 * channel + i}" for channel in range(3) for i in range(count)]
    kept = {n: c for n, c in columns.items() if not n.startswith("f_rest_")} | {f"f_rest_{i}": columns[n] for i, n in enumerate(rest)}
    write_vertices(tmp_path / "low.ply", kept)
    scene = run_folder.open_run(import_files(tmp_path / "low.ply", Data(folder), tmp_path / "again")).scene
    full = run_folder.open_run(run).scene.table.params["sh_rest"]
    assert scene.config.sh_degree == degree and torch.equal(scene.table.params["sh_rest"], full[:, :count])


@pytest.mark.parametrize("format", list(registry.formats_of("gaussians")))
def test_every_standard_file_comes_back_as_a_run(made, tmp_path, format):
    run, folder = made
    file = tmp_path / f"scene{registry.format_named(format).suffix}"
    export_run(run, format, file)
    out = import_files(file, Data(folder), tmp_path / "again")
    opened, there, world = run_folder.open_run(out), registry.read(file), captures.load(Data(folder)).world
    assert opened.config.train.recipe == "3dgs" and opened.scene.config.sh_degree == there.degree == (0 if format == "splat" else 3)
    torch.testing.assert_close(
        world.to_input(opened.scene.table.params["means"].detach().double()).float(), there.means, atol=1e-4, rtol=1e-5
    )
    assert (drawn(out) - drawn(run)).abs().mean() < 0.02
    whole = file.read_bytes()
    end = whole.find(b'id="scene"') + 500 if format == "baked-html" else len(whole) * 2 // 3 // 32 * 32 + 5
    file.write_bytes(whole[:end])
    with pytest.raises(InputError, match=r"^[^\n]+$"):
        import_files(file, Data(folder), tmp_path / "damaged")
    assert not (tmp_path / "damaged").exists()


def test_beside_a_description_of_more_harmonics_the_file_says_the_degree(made, tmp_path):
    run, folder = made
    layout = write_result_folder(run_folder.open_run(run), captures.load(Data(folder)), tmp_path / "result")
    splat.write(layout / "scene.splat", ply.read(layout / "point_cloud.ply"), {})
    opened = run_folder.open_run(import_files(layout / "scene.splat", Data(folder), tmp_path / "again"))
    assert opened.step == 90 and opened.scene.config.sh_degree == 0


@pytest.mark.parametrize("format", ["spz", "baked-html", "ply", "compressed-ply", "sog"])
def test_a_file_says_by_itself_whether_it_is_antialiased(made, tmp_path, format):
    run, folder = made
    opened, name = run_folder.open_run(run), f"scene{registry.format_named(format).suffix}"
    for asked in (False, True):
        one = replace(opened, config=replace(opened.config, train=replace(opened.config.train, antialias=asked)))
        export(one, format, tmp_path / name, Options(measure=False))
        (tmp_path / f"{name}.json").unlink()
        out = import_files(tmp_path / name, Data(folder), tmp_path / f"{asked}")
        assert run_folder.read_config(out).train.antialias is asked


def test_the_description_beside_a_file_is_heard(made, tmp_path, caplog):
    run, folder = made
    to_ply(run, tmp_path / "scene.ply")
    about = json.loads((tmp_path / "scene.ply.json").read_text())
    (tmp_path / "scene.ply.json").write_text(json.dumps(about | {"antialias": True}))
    assert run_folder.read_config(import_files(tmp_path / "scene.ply", Data(folder), tmp_path / "again")).train.antialias
    assert not caplog.records
    import_files(tmp_path / "scene.ply", Data(folder, split="none"), tmp_path / "elsewhere")
    assert "--split" in caplog.text
    export_run(run, "ply", tmp_path / "scene.ply", frame="trained")
    with pytest.raises(InputError, match="--frame capture"):
        import_files(tmp_path / "scene.ply", Data(folder), tmp_path / "other")


def test_files_that_hold_no_gaussians_are_named(made, tmp_path):
    folder = made[1]
    (tmp_path / "text").write_text("x")
    (tmp_path / "none.splat").write_bytes(b"")
    (tmp_path / "cut.compact").write_bytes(b"x")
    write_vertices(tmp_path / "anchors.ply", {name: np.zeros(2, np.float32) for name in (*"xyz", "f_offset_0")})
    for name in ("text", "none.splat", "cut.compact", "anchors.ply"):
        with pytest.raises(InputError, match=naming(name)):
            import_files(tmp_path / name, Data(folder), tmp_path / "again")


def test_formats_that_do_not_fit_are_refused_in_one_sentence(made, tmp_path):
    run, folder = made
    for format in ("anchors", "compact"):
        with pytest.raises(InputError, match=naming("3dgs", "--format ply")):
            export_run(run, format, tmp_path / "x")
    to_ply(run, tmp_path / "bad.ply")
    columns = {name: column.copy() for name, column in read_vertices(tmp_path / "bad.ply").items()}
    columns["opacity"][::9] = np.nan
    write_vertices(tmp_path / "bad.ply", columns)
    with pytest.raises(InputError, match=naming("opacity_logit", "bad.ply")):
        import_files(tmp_path / "bad.ply", Data(folder), tmp_path / "again")


@pytest.mark.parametrize("name", ["a.ply", "a.PLY", "a.compressed.ply", "a.zip", "a.sog", "a.glb", "a.usdc", "a.usda"])
def test_a_file_alone_tells_its_origin(name, tmp_path):
    if "usd" in name:
        pytest.importorskip("pxr")
    path = tmp_path / name
    formats = {".zip": "ply", ".PLY": "ply", ".ply": "ply", ".usda": "usd", ".usdc": "usd"}
    format = registry.format_named("compressed-ply" if "compressed" in name else formats.get(path.suffix, path.suffix[1:]))
    target = tmp_path / "inner.ply" if name in ("a.zip", "a.PLY") else path
    format.write(target, splats(20), {"origin": [448250.0, 5411932.0, 340.0], "antialias": False})
    if name == "a.PLY":
        target.rename(path)
    if name == "a.zip":
        with zipfile.ZipFile(path, "w") as archive:
            archive.write(target, "inner.ply")
        target.unlink()
    assert noted_origin(path) == (448250.0, 5411932.0, 340.0)
