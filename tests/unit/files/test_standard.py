"""Standard Gaussians in files of every format: what is printed and noted is what the file gives."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.data import capture as captures
from scene_experts.data.settings import Data
from scene_experts.data.views import World
from scene_experts.evaluate.metrics import psnr
from scene_experts.files import registry
from scene_experts.files.export import Options, export, export_several
from scene_experts.files.gaussians.read import DRAWN_AT, scene_of, table_columns
from scene_experts.files.gaussians.write import splats_of
from scene_experts.files.measure import Painter
from scene_experts.files.registry import GAUSSIANS, formats_of
from scene_experts.files.scene_folder import write_result_folder
from scene_experts.render import choose
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.recipes import RECIPES
from support.files import export_run
from support.messages import naming
from support.synthetic import make_capture

SHORT = {"sh_degree": 1, "refine": 5}


def short_run(recipe: str, root: Path) -> Path:
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=250, scale=3.0).folder
    config = RunConfig(replace(RECIPES[recipe][1], iterations=300), Data(folder), stop_at=20)
    run_folder.prepare(root / "run", config, resume=False)
    capture = captures.load(config.data)
    list(train(config.train, Job(config, root / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    return root / "run"


@pytest.fixture(scope="module", params=["moe-gs", "sags", "3dgs"])
def short(request, tmp_path_factory) -> Path:
    return short_run(request.param, tmp_path_factory.mktemp(request.param))


def measured(short: Path, file: Path, world: World | None = None) -> float:
    """PSNR of the held-out views as our own renderer draws the file."""
    opened = run_folder.open_run(short)
    capture, draw, total = captures.load(opened.config.data), choose("auto", "cpu"), 0.0
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
    capture = captures.load(opened.config.data)
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


@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_a_capture_that_moved_is_found_by_its_flag(short, tmp_path):
    data = run_folder.read_config(short).data.path
    (tmp_path / "moved").symlink_to(data)
    (written,) = export_run(short, "ply", tmp_path / "x.ply", data=tmp_path / "moved", measure=True, **SHORT)
    assert "held-out views" in written.lines[2]


@pytest.mark.parametrize("short", ["3dgs"], indirect=True)
def test_plain_gaussians_need_no_capture(short, tmp_path):
    opened = run_folder.open_run(short)
    capture = captures.load(opened.config.data)
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
