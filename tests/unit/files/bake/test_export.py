"""Runs to standard files: baked, written, read again, and measured from what was read."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from scene_experts.files.bake.export import Options, export_standard, files, scene_of
from scene_experts.files.bake.measure import picture
from scene_experts.files.formats.standard import FORMATS, read_standard

from scene_experts.core.errors import InputError
from scene_experts.data.views import World
from scene_experts.evaluate.metrics import psnr
from scene_experts.files.bake.bake import Bake
from scene_experts.files.bake.refine import DRAWN_AT, Refine
from scene_experts.files.export import write_layout
from scene_experts.files.formats.splats import from_scene
from scene_experts.recipes import RECIPES
from scene_experts.render import choose
from scene_experts.scene.anchors.scene import AnchorScene
from scene_experts.scene.anchors.select import LevelSelector
from scene_experts.training import run_folder
from scene_experts.training.config import Data, RunConfig
from scene_experts.training.loop import Run, train
from support.messages import naming
from support.synthetic import make_capture

SHORT = Bake(sh_degree=1, refine=Refine(iterations=5))


def trained(recipe: str, root: Path) -> Path:
    folder = make_capture(root / "capture", views=9, size=(48, 32), points=250, scale=3.0).folder
    config = RunConfig(replace(RECIPES[recipe][1], iterations=300), Data(folder), stop_at=20)
    run_folder.prepare(root / "run", config, resume=False)
    capture = run_folder.load_capture(config.data)
    list(train(config.train, Run(config, root / "run"), capture, choose("auto", "cpu")))
    capture.images.close()
    return root / "run"


@pytest.fixture(scope="module", params=["moe-gs", "sags", "3dgs"])
def run(request, tmp_path_factory) -> Path:
    return trained(request.param, tmp_path_factory.mktemp(request.param))


def measured(run: Path, file: Path, world: World | None = None) -> float:
    """PSNR of the held-out views as our own renderer draws the file."""
    opened = run_folder.open_run(run)
    capture, draw, total = run_folder.load_capture(opened.config.data), choose("auto", "cpu"), 0.0
    scene = scene_of(read_standard(file), world or capture.world, capture.extent)
    with torch.no_grad():
        for index in capture.test:
            image = picture(scene, DRAWN_AT, capture.views[index].camera, torch.tensor(capture.background), draw)
            total += psnr(image, capture.frame(index).rgb.float() / 255)
    capture.images.close()
    return total / len(capture.test)


def test_what_is_printed_is_what_the_file_gives(run, tmp_path):
    said = []
    options = Options(SHORT, command="scene-experts export RUN")
    lines = export_standard(run, "ply", tmp_path / "a.ply", None, choose("auto", "cpu"), options, tell=lambda *what: said.append(what[0]))
    about = json.loads((tmp_path / "a.ply.json").read_text())
    assert lines[0] == f"wrote {tmp_path / 'a.ply'}" and "held-out views" in lines[2]
    assert f"{about['psnr']['file']['photographs']:.3f} dB" in lines[2]
    assert measured(run, tmp_path / "a.ply") == pytest.approx(about["psnr"]["file"]["photographs"], abs=2e-5)
    assert about["gaussians"] == len(read_standard(tmp_path / "a.ply")) > 50 and about["command"] == options.command
    assert about["bytes"] == (tmp_path / "a.ply").stat().st_size and about["frame"] == "capture"
    assert about["sh_degree"] == 1 and about["bake"]["refine"]["iterations"] == 5
    assert {"run", "closed_form", "bake", "file", "views"} == set(about["psnr"]) and "refining" in said


@pytest.mark.parametrize("run", ["moe-gs", "3dgs"], indirect=True)
def test_frames_and_folders(run, tmp_path):
    draw, still = choose("auto", "cpu"), Bake(sh_degree=3, refine=Refine(iterations=0))
    export_standard(run, "ply", tmp_path, None, draw, Options(still, measure=False))
    lines = export_standard(run, "ply", tmp_path / "world.ply", None, draw, Options(still, "trained", measure=False))
    assert len(lines) == 2
    opened = run_folder.open_run(run)
    capture = run_folder.load_capture(opened.config.data)
    capture.images.close()
    own, world = read_standard(tmp_path / "scene.ply"), read_standard(tmp_path / "world.ply")
    assert capture.world.scale != 1 and own.degree == 3
    torch.testing.assert_close(capture.world.from_input(own.means.double()).float(), world.means, rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(own.log_scales + math.log(capture.world.scale), world.log_scales, rtol=1e-4, atol=1e-4)
    assert measured(run, tmp_path / "world.ply", World()) == pytest.approx(measured(run, tmp_path / "scene.ply"), abs=0.01)


@pytest.mark.parametrize("run", ["moe-gs"], indirect=True)
@pytest.mark.slow
def test_each_format_is_measured_from_its_own_file(run, tmp_path):
    for format, of in FORMATS.items():
        path = tmp_path / f"scene{of.suffix}"
        export_standard(run, format, path, None, choose("auto", "cpu"), Options(Bake(sh_degree=1, refine=Refine(iterations=0))))
        about = json.loads(path.with_name(path.name + ".json").read_text())
        assert measured(run, path) == pytest.approx(about["psnr"]["file"]["photographs"], abs=2e-5), format
        assert about["sh_degree"] == (0 if format == "splat" else 1)


@pytest.mark.parametrize("run", ["moe-gs"], indirect=True)
def test_what_cannot_be_is_refused_in_one_sentence(run, tmp_path):
    draw = choose("auto", "cpu")
    with pytest.raises(InputError, match=naming("obj", "ply")):
        export_standard(run, "obj", None, None, draw)
    with pytest.raises(InputError, match="--levels"):
        export_standard(run, "ply", tmp_path / "x.ply", None, draw, Options(levels=True))
    with pytest.raises(InputError, match="--sh-degree"):
        export_standard(run, "ply", tmp_path / "x.ply", None, draw, Options(Bake(sh_degree=5)))
    with pytest.raises(InputError, match=naming("gone", "--data")):
        export_standard(run, "ply", tmp_path / "x.ply", None, draw, Options(SHORT), data=tmp_path / "gone")
    other = make_capture(tmp_path / "other", views=10, size=(48, 32), points=50).folder
    with pytest.raises(InputError, match="--data"):
        export_standard(run, "ply", tmp_path / "x.ply", None, draw, Options(SHORT), data=other)


@pytest.mark.parametrize("run", ["moe-gs"], indirect=True)
def test_a_capture_that_moved_is_found_by_its_flag(run, tmp_path):
    data = run_folder.read_config(run).data.path
    (tmp_path / "moved").symlink_to(data)
    lines = export_standard(run, "ply", tmp_path / "x.ply", None, choose("auto", "cpu"), Options(SHORT), data=tmp_path / "moved")
    assert "held-out views" in lines[2]


@pytest.mark.parametrize("run", ["3dgs"], indirect=True)
def test_plain_gaussians_need_no_capture(run, tmp_path):
    opened = run_folder.open_run(run)
    capture = run_folder.load_capture(opened.config.data)
    capture.images.close()
    write_layout(opened, capture)
    lines = export_standard(run, "ply", tmp_path / "x.ply", None, choose("auto", "cpu"), data=tmp_path / "gone")
    assert "held-out" not in lines[2]
    torch.testing.assert_close(read_standard(tmp_path / "x.ply").means, from_scene(opened.scene, capture.world).means)


@pytest.mark.slow
def test_levels_of_detail_become_one_file_each(tmp_path):
    run = trained("octree-gs", tmp_path)
    scene = run_folder.open_run(run).scene
    assert isinstance(scene, AnchorScene) and isinstance(scene.select, LevelSelector)
    options = Options(replace(SHORT, refine=Refine(iterations=0)), levels=True)
    lines = export_standard(run, "ply", tmp_path / "out.ply", None, choose("auto", "cpu"), options)
    written = sorted(tmp_path.glob("out_level*.ply"))
    count = len(scene.table.facts["level"].unique())
    assert len(written) == count > 1 and len(lines) == 3 * count
    sizes = [len(read_standard(file)) for file in written]
    assert sizes == sorted(set(sizes))  # a level without anchors gets no file
    assert json.loads((tmp_path / "out_level1.ply.json").read_text())["level"] == 1
    assert files(run_folder.open_run(run), tmp_path / "bare", True)[0][1].name == "bare_level0"
