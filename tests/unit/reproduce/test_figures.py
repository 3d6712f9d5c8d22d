"""Charts: drawn where runs are done, nothing where none is."""

import pytest
from PIL import Image

from scene_experts.reproduce import figures
from scene_experts.reproduce.experiments import EXPERIMENTS
from support.records import record

pytest.importorskip("matplotlib")


def whole(paths):
    assert [p.suffix for p in paths] == [".png"]
    assert min(Image.open(paths[0]).size) > 300
    return True


def test_no_runs_no_charts(tmp_path):
    assert figures.layers(EXPERIMENTS["fig7"], [], tmp_path / "a") == figures.cost(EXPERIMENTS["fig6"], [], tmp_path / "b") == []
    assert figures.expert_shares(EXPERIMENTS["fig3"], [], "fox", tmp_path / "c") == []
    assert figures.relative_psnr(EXPERIMENTS["fig1b"], [record()], ["fox"], tmp_path / "d") == [] and not list(tmp_path.iterdir())


@pytest.mark.slow
def test_figure_3_and_7_and_6(tmp_path):
    pair = [record("moe-gs-e3-top2"), record("moe-gs-e3-no-load")]
    assert whole(figures.expert_shares(EXPERIMENTS["fig3"], pair, "fox", tmp_path / "fig3"))
    assert (
        figures.expert_shares(EXPERIMENTS["fig3"], pair, "fox", tmp_path / "other", attribute="opacity") == []
    )  # nothing was logged of it
    first = {p.name: p.read_bytes() for p in tmp_path.iterdir()}
    figures.expert_shares(EXPERIMENTS["fig3"], pair, "fox", tmp_path / "fig3")
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == first  # the same bytes again
    depths = [record(f"scaffold-gs-depth{n}", seed=s, psnr=30 - n + s) for n in (2, 3) for s in (0, 1)]
    assert whole(figures.layers(EXPERIMENTS["fig7"], depths, tmp_path / "fig7"))
    assert whole(figures.cost(EXPERIMENTS["fig6"], [record("moe-gs-e2-top1"), record("moe-gs-e5-top1")], tmp_path / "fig6"))


def test_figure_1b_is_relative_to_3dgs_in_order_of_anchors(tmp_path, monkeypatch):
    runs = [record("3dgs", s, psnr=20.0, views=1, anchors=9) for s in ("fox", "fern")]
    runs += [record("scaffold-gs", "fox", psnr=22.0, views=1, anchors=900), record("scaffold-gs", "fern", psnr=21.0, views=1, anchors=100)]
    runs += [record("moe-gs", "fox", psnr=23.0, views=1), record("moe-gs", "lone", psnr=23.0, views=1)]
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or [path])
    assert figures.relative_psnr(EXPERIMENTS["fig1b"], runs, ["fox", "fern", "lone"], tmp_path / "fig1b") == [tmp_path / "fig1b"]
    (axes,) = drawn[0].axes
    assert [tick.get_text() for tick in axes.get_xticklabels()] == ["fern\n0k", "fox\n1k"]
    heights = [round(bar.get_height(), 6) for bar in axes.patches]
    assert heights == [5.0, 10.0, 15.0] and [round(bar.get_x() + bar.get_width() / 2) for bar in axes.patches] == [0, 1, 1]


def test_figures_compare_the_same_seeds(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures, "save", lambda figure, path: drawn.append(figure) or [path])
    runs = [record("3dgs", seed=s, psnr=psnr, views=1) for s, psnr in ((0, 20.0), (1, 10.0))]
    runs += [record("scaffold-gs", psnr=21.0, views=1), record("moe-gs", seed=2, psnr=30.0, views=1)]
    figures.relative_psnr(EXPERIMENTS["fig1b"], runs, ["fox"], tmp_path / "fig1b")
    assert [round(bar.get_height(), 6) for bar in drawn[0].axes[0].patches] == [5.0]  # seed 0; moe-gs has no seed of 3dgs
    deep = [record(f"scaffold-gs-depth{n}", seed=s, psnr=30.0 - 10 * s, views=1) for n, seeds in ((2, (0, 1)), (3, (0,))) for s in seeds]
    figures.layers(EXPERIMENTS["fig7"], deep, tmp_path / "fig7")
    assert list(drawn[1].axes[0].lines[0].get_ydata()) == [30.0, 30.0]
    timed = [
        record(recipe, seed=s, psnr=30.0 - 10 * s, views=1)
        for recipe, s in (("moe-gs-e2-top1", 0), ("moe-gs-e2-top1", 1), ("moe-gs-e3-top1", 0))
    ]
    figures.cost(EXPERIMENTS["fig6"], timed, tmp_path / "fig6")
    assert list(drawn[2].axes[0].lines[0].get_ydata()) == [30.0, 30.0]
