"""Photographs of a run by how badly the scene fits them."""

from __future__ import annotations

from pathlib import Path

import pytest

import scene_experts as se
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.evaluate.photographs import NAMED, describe_outliers, read_photographs
from scene_experts.evaluate.pictures import read_picture
from scene_experts.report.page import write
from support.synthetic import make_capture


def scores(*values: float) -> dict[str, dict[str, object]]:
    return {f"{i}.png": {"file": f"{i}.png", "psnr": value} for i, value in enumerate(values)}


def test_the_order_is_by_the_median_of_each_part(tmp_path: Path) -> None:
    write_json(tmp_path / "per_view.json", {"held.png": {"file": "held.png", "psnr": 19.0}})
    assert [each.part for each in read_photographs(tmp_path)] == ["held out"]
    write_json(tmp_path / "training_views.json", scores(30.0, 30.5, 14.2, 29.5, 30.0, 28.5))
    found = read_photographs(tmp_path)
    assert [each.name for each in found[:2]] == ["2.png", "5.png"] and len(found) == 7
    (line,) = describe_outliers(found)
    assert line.startswith("2.png fits the others badly (14.2 dB, median 29.8)") and line.endswith("--leave-out 2.png")


@pytest.mark.parametrize("values", [(30.0, 30.0, 30.0, 30.0, 27.5), (30.0, 30.0, 30.0, 12.0), (20.0, 22.0, 25.0, 28.0, 30.0, 16.0)])
def test_little_or_usual_differences_are_no_outliers(tmp_path: Path, values: tuple[float, ...]) -> None:
    write_json(tmp_path / "training_views.json", scores(*values))
    assert describe_outliers(read_photographs(tmp_path)) == []


def test_many_outliers_are_few_lines(tmp_path: Path) -> None:
    write_json(tmp_path / "training_views.json", scores(*[30.0] * 100, *[10.0] * 8))
    lines = describe_outliers(read_photographs(tmp_path))
    assert len(lines) == NAMED + 1 and lines[-1].startswith("3 more")


def test_a_part_of_the_scene_that_fits_badly_is_no_slip_to_leave_out(tmp_path: Path) -> None:
    write_json(tmp_path / "training_views.json", scores(*[30.0, 30.5, 29.5] * 5, *[20.0] * 5))
    (line,) = describe_outliers(read_photographs(tmp_path))
    assert line.startswith("5 of 20 photographs fit the others badly (15.png, ") and "--leave-out" not in line


@pytest.mark.parametrize("wrong", [[1], {"a.png": {}}, {"a.png": {"file": "../../a.png", "psnr": 1.0}}])
def test_files_of_others_are_refused(tmp_path: Path, wrong: object) -> None:
    write_json(tmp_path / "training_views.json", wrong)
    with pytest.raises(InputError):
        read_photographs(tmp_path)


@pytest.mark.slow
def test_a_bad_photograph_is_first_and_named(tmp_path: Path) -> None:
    made = make_capture(tmp_path / "made", views=14, size=(48, 32), points=800, mixed_sizes=False)
    bad = tmp_path / "made" / "images" / "view_003.png"
    from PIL import Image, ImageOps

    with Image.open(bad) as picture:
        ImageOps.invert(picture).save(bad)
    run = se.train(se.recipe("scaffold-gs", iterations=150, **{"scene.voxel_size": 0.1}), made.folder, tmp_path / "run", progress=False)
    run.evaluate(lpips=False)
    found = read_photographs(tmp_path / "run")
    assert (tmp_path / "run" / "training_views.json").is_file()
    assert len(found) == 14 and (found[0].name, found[0].part) == ("view_003.png", "training")
    assert any(line.startswith("view_003.png fits the others badly") for line in describe_outliers(found))
    for kind in ("gt", "renders"):
        assert read_picture(tmp_path / "run" / "training_views" / kind / "view_003.png").shape == (32, 48, 3)
    text = write([tmp_path / "run"]).read_text().partition("<h2>Photographs</h2>")[2]
    assert text.index("view_003.png") < text.index("view_004.png") and "fits badly" in text
    assert all(f"<td>{name}</td>" in text for name in made.images)
