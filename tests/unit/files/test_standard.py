"""Standard Gaussians of a run: frames, measures, levels of detail."""

import json
import math

import pytest
import torch

from scene_experts.data.views import World
from scene_experts.files import registry
from scene_experts.files.export import export
from scene_experts.files.gaussians.write import splats_of
from scene_experts.files.options import Options
from scene_experts.files.own import write_result_folder
from scene_experts.files.registry import GAUSSIANS, formats_of
from scene_experts.training import run_folder
from support.exports import SHORT, measured, short_run
from support.files import export_run


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


@pytest.mark.slow
@pytest.mark.parametrize("short", ["moe-gs"], indirect=True)
def test_each_format_is_measured_from_its_own_file(short, tmp_path):
    for format, of in formats_of(GAUSSIANS).items():
        path = tmp_path / f"scene{of.suffix}"
        export_run(short, format, path, sh_degree=1, refine=0, measure=True)
        about = json.loads(path.with_name(path.name + ".json").read_text())
        assert measured(short, path) == pytest.approx(about["psnr"]["file"]["photographs"], abs=2e-5), format
        assert about["sh_degree"] == (0 if format == "splat" else 1)


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
    assert export_run(short, "ply", tmp_path / "bare", refine=0, levels=True)[0].path.name == "bare_level0"
