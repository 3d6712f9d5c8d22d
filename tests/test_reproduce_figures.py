"""Charts: drawn where runs are done, nothing where none is."""

import pytest
from PIL import Image

from records import record
from scene_experts.reproduce import figures
from scene_experts.reproduce.experiments import EXPERIMENTS

pytest.importorskip("matplotlib")


def whole(paths):
    assert {p.suffix for p in paths} == {".png", ".svg"}
    assert min(Image.open(next(p for p in paths if p.suffix == ".png")).size) > 300
    return True


def test_no_runs_no_charts(tmp_path):
    assert figures.layers(EXPERIMENTS["fig7"], [], tmp_path / "a") == figures.cost(EXPERIMENTS["fig6"], [], tmp_path / "b") == []
    assert figures.shares(EXPERIMENTS["fig3"], [], "fox", tmp_path / "c") == []
    assert figures.relative_psnr(EXPERIMENTS["fig1b"], [record()], ["fox"], tmp_path / "d") == [] and not list(tmp_path.iterdir())


def test_figure_3_and_7_and_6(tmp_path):
    pair = [record("moe-gs-e3-top2"), record("moe-gs-e3-no-load")]
    assert whole(figures.shares(EXPERIMENTS["fig3"], pair, "fox", tmp_path / "fig3"))
    first = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    figures.shares(EXPERIMENTS["fig3"], pair, "fox", tmp_path / "fig3")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == first  # the same bytes again
    depths = [record(f"scaffold-gs-depth{n}", seed=s, psnr=30 - n + s) for n in (2, 3) for s in (0, 1)]
    assert whole(figures.layers(EXPERIMENTS["fig7"], depths, tmp_path / "fig7"))
    assert whole(figures.cost(EXPERIMENTS["fig6"], [record("moe-gs-e2-top1"), record("moe-gs-e5-top1")], tmp_path / "fig6"))
