"""`info RUN`: the facts of a run folder."""

import shutil
import zipfile

import pytest

import scene_experts as se
from scene_experts.commands import inspect
from scene_experts.commands.run_facts import find_facts, find_file_facts, find_scores, propose_next
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from support.synthetic import make_capture


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    capture = make_capture(tmp_path_factory.mktemp("captures") / "balls", views=3, size=(16, 12), points=40).folder
    recipe = se.recipe("scaffold-gs", iterations=2, **{"scene.voxel_size": 0.5})
    return se.train(recipe, capture, tmp_path_factory.mktemp("runs") / "run", progress=False).path


def test_the_facts_of_a_run_tell_what_it_is_and_what_comes_next(run, capsys):
    facts = find_facts(run)
    assert facts["recipe"] == "scaffold-gs" and facts["iterations"].startswith("2, in") and "none" in facts["scores"]
    assert inspect.info([str(run)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "scaffold-gs" in shown and f"next: scene-experts eval {run}" in shown


def test_options_of_captures_are_refused_for_runs(run):
    with pytest.raises(InputError, match="--split"):
        inspect.info([str(run), "--split", "none"])


@pytest.mark.parametrize("format, suffix", [("compact", ".compact"), ("ply", ".ply"), ("sog", ".sog")])
def test_the_facts_of_a_file_tell_its_format_size_and_rows_without_a_capture(run, tmp_path, capsys, format, suffix):
    (tmp_path / "its own").mkdir()
    file = se.open_run(run).export(format, tmp_path / f"its own/balls{suffix}")
    assert inspect.info([str(file)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"format {format}, {file.stat().st_size:,} bytes" in shown and f"next: scene-experts view '{file}'" in shown
    facts = find_file_facts(file)
    assert int(facts["anchors" if format == "compact" else "Gaussians"].replace(",", "")) > 10
    assert facts["iterations"] == "2" and facts["extent"].count(" x ") == 2
    with pytest.raises(InputError, match="expected no --split with a scene"):
        inspect.info([str(file), "--split", "none"])


def test_a_result_folder_has_facts_and_a_file_of_something_else_is_no_scene(run, tmp_path):
    assert find_file_facts(se.open_run(run).export("ply", tmp_path / "a.ply"))["recipe"] == "scaffold-gs"
    shutil.copytree(run / "point_cloud", tmp_path / "result/point_cloud")
    assert inspect.is_scene(tmp_path / "result") and "anchors" in find_file_facts(tmp_path / "result")
    (tmp_path / "notes.txt").write_text("nothing")
    with pytest.raises(InputError, match="expected a file of a known format"):
        inspect.info([str(tmp_path / "notes.txt")])


def test_folders_with_files_of_such_names_are_no_scenes(run, tmp_path):
    for text in ("{}", "no JSON", "[1]"):
        (tmp_path / "meta.json").write_text(text)
        assert not inspect.is_scene(tmp_path)
    (tmp_path / "point_cloud").mkdir()
    assert not inspect.is_scene(tmp_path) and not inspect.is_scene(tmp_path / "nothing")
    sog = se.open_run(run).export("sog", tmp_path / "a.sog")
    with zipfile.ZipFile(sog) as packed:
        packed.extractall(tmp_path / "folder")
    size = sum(file.stat().st_size for file in (tmp_path / "folder").iterdir())
    assert inspect.is_scene(tmp_path / "folder") and find_file_facts(tmp_path / "folder")["format"] == f"sog, {size:,} bytes"
    assert inspect.info([f"--data={tmp_path / 'folder'}"]) == 0


def test_scores_are_told_with_their_iteration_and_damaged_ones_are_none(tmp_path):
    assert find_scores(tmp_path) == ""
    write_json(tmp_path / "results.json", {"psnr": 27.123, "ssim": 0.8, "lpips": 0.25, "step": 3000})
    assert find_scores(tmp_path) == "PSNR 27.12 dB, SSIM 0.800, LPIPS 0.250 (held-out views, iteration 3,000)"
    assert propose_next(tmp_path).startswith("scene-experts export")
    write_json(tmp_path / "results.json", {"psnr": "high"})
    assert find_scores(tmp_path) == ""
    (tmp_path / "results.json").unlink()
    write_json(tmp_path / "results_train.json", {"psnr": 33.0, "ssim": 0.9, "step": 100, "views": "train"})
    assert find_scores(tmp_path) == "PSNR 33.00 dB, SSIM 0.900 (training views, iteration 100)"
    assert propose_next(tmp_path).startswith("scene-experts export")
