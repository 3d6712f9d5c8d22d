"""`info RUN`: the facts of a run folder."""

import pytest

import scene_experts as se
from scene_experts.commands import inspect
from scene_experts.commands.run_facts import find_facts, find_scores, propose_next
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


def test_scores_are_told_with_their_iteration_and_damaged_ones_are_none(tmp_path):
    assert find_scores(tmp_path) == ""
    write_json(tmp_path / "results.json", {"psnr": 27.123, "ssim": 0.8, "lpips": 0.25, "step": 3000})
    assert find_scores(tmp_path) == "PSNR 27.12 dB, SSIM 0.800, LPIPS 0.250 (held-out views, iteration 3,000)"
    assert propose_next(tmp_path).startswith("scene-experts export")
    write_json(tmp_path / "results.json", {"psnr": "high"})
    assert find_scores(tmp_path) == ""
