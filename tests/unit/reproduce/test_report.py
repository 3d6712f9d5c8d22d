"""What an experiment writes: tables in three forms, charts, the claims, and a page that leads to them."""

import pytest

from scene_experts.cli import main
from scene_experts.core.errors import InputError
from scene_experts.reproduce import report
from scene_experts.reproduce.compare import make_comparison
from scene_experts.reproduce.experiments import EXPERIMENTS
from scene_experts.reproduce.options import ReproduceOptions
from scene_experts.reproduce.plan import OWN, CaptureSpec
from support.records import record
from support.synthetic import make_capture

pytest.importorskip("matplotlib")


def test_files_and_page(tmp_path):
    scenes = [CaptureSpec(name, OWN, tmp_path / name) for name in ("fox", "fern")]
    runs = [record(recipe, scene.name, psnr=30.0 + i) for scene in scenes for i, recipe in enumerate(("scaffold-gs", "moe-gs"))]
    stray = record("moe-gs", "elsewhere", psnr=99.0)
    report.write(tmp_path, [EXPERIMENTS["table4"], EXPERIMENTS["fig7"]], scenes, [*runs, stray], "scene-experts reproduce table4 fig7")
    assert {"table4.md", "table4.csv", "table4.tex", "README.md"} <= {p.name for p in tmp_path.iterdir()}
    assert not (tmp_path / "fig7.png").exists()
    page = (tmp_path / "README.md").read_text()
    assert "scene-experts reproduce table4 fig7" in page and "](fig7." not in page
    assert "(table4.md)" in page and "| confirmed | +1.00 dB" in page
    assert "99" not in (tmp_path / "table4.md").read_text()
    assert "fern" in (tmp_path / "table4.md").read_text()


def test_means_are_over_the_captures_that_every_row_has(tmp_path):
    scenes = [CaptureSpec(name, OWN, tmp_path / name) for name in ("fox", "fern")]
    runs = [record("moe-gs", "fox", psnr=30.0, views=1), record("scaffold-gs-opacity", "fox", psnr=29.0, views=1)]
    report.write(tmp_path, [EXPERIMENTS["table4"]], scenes, [*runs, record("moe-gs", "fern", psnr=10.0, views=1)])
    means, by_scene = (tmp_path / "table4.md").read_text().split("scene by scene")
    assert "means over fox\n" in means and "| MoE-GS | **30.00** |" in means and "fern" in means and "10.00" not in means
    assert "10.00" in by_scene


def test_rows_without_a_common_capture_are_said_not_to_compare(tmp_path):
    scenes = [CaptureSpec(name, OWN, tmp_path / name) for name in ("fox", "fern")]
    runs = [record("moe-gs", "fox", psnr=30.0), record("scaffold-gs-opacity", "fern", psnr=20.0)]
    report.write(tmp_path, [EXPERIMENTS["table4"]], scenes, runs)
    assert report.DISJOINT in (tmp_path / "table4.md").read_text()
    report.write(tmp_path, [EXPERIMENTS["table4"]], scenes, [*runs, record("moe-gs", "fern", psnr=10.0)])
    assert report.DISJOINT not in (tmp_path / "table4.md").read_text()


def test_a_comparison_has_no_claims_and_the_differences_from_its_baseline(tmp_path):
    scenes = [CaptureSpec(name, OWN, tmp_path / name) for name in ("fox", "fern", "box")]
    experiment = make_comparison(ReproduceOptions(("compare",), recipes=("moe-gs-balance", "3dgs", "scaffold-gs"), baseline=("3dgs",)))
    runs = [record(r, s.name, psnr=p) for s in scenes for r, p in (("moe-gs-balance", 30.5), ("3dgs", 30.0))]
    runs.append(record("scaffold-gs", "fox", psnr=29.0))
    report.write(tmp_path, [experiment], scenes, runs)
    assert "claims" not in (tmp_path / "README.md").read_text()
    text = (tmp_path / "compare.md").read_text()
    assert "PSNR minus that of 3dgs" in text and "| moe-gs-balance | +0.50 | +0.50 | +0.50 | +0.50 |" in text
    assert "| scaffold-gs | -1.00 | - | - | -1.00 |" in text and "no pair of runs on fern, box" in text


def test_short_trainings_are_said_to_be_no_judges():
    assert report.caveat([record(iterations=30_000)]) == report.caveat([]) == []
    (line, _) = report.caveat([record(iterations=3000), record(iterations=200)])
    assert all(fact in line for fact in ("3,000", "13", "30,000"))
    several = report.caveat([record("octree-gs"), record()])[0]
    assert all(fact in several for fact in ("3,000", "13", "17"))
    assert "200" in report.caveat([record(iterations=200)])[0]


def test_the_longer_schedule_of_octree_gs_does_not_hide_that_the_others_are_short():
    scaled = [record("moe-gs", iterations=22_500), record("octree-gs", iterations=30_000)]  # --scale 0.75
    assert "22,500 iterations" in report.caveat(scaled)[0]
    assert report.caveat([record("moe-gs", iterations=30_000), record("octree-gs", iterations=40_000)]) == []


def test_a_run_with_a_background_or_a_near_plane_of_its_own_is_not_adopted(tmp_path):
    words = ["--data", str(make_capture(tmp_path / "box", views=9, size=(48, 32), points=300).folder), "--iterations", "4"]
    words += ["--mean-background", "--near-share", "0.5", "--device", "cpu", "--preview-every", "0"]
    for name, own in (("plain", []), ("background", ["--background", "1", "1", "1"]), ("near", ["--near", "0.123"])):
        assert main(["train", "scaffold-gs", "--out", str(tmp_path / name), *words, *own]) == 0
        why = "expected an evaluated run" if name == "plain" else rf"expected the {name} that the recipe has .* without --{name}"
        with pytest.raises(InputError, match=why):
            report.adopt(tmp_path / name, [])
