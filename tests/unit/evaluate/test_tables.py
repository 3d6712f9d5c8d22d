"""Tables of results: formats, protocols that must agree, the paper's numbers."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from scene_experts.core.errors import InputError
from scene_experts.evaluate import tables
from support.messages import naming


def results(recipe: str, psnr: float, **other: Any) -> dict[str, Any]:
    return {
        "recipe": recipe,
        "capture": "yard",
        "resolution": "as-is",
        "mean_pixels": 5000,
        "split": "mod8",
        "views": "test",
        "view_count": 9,
        "masked": False,
        "psnr": psnr,
        "ssim": 0.9,
        "lpips": 0.2,
        "lpips_3dgs": 0.19,
        "lpips_alex": None,
        "absent": {"lpips_alex": "no weights: run this"},
        "size": {"MB": 1.25},
        "anchors": 12345,
        "activation_ratio": 0.365,
        "detail": 0.93,
        "fps": {"fps": 20.0, "decode_ms": 10.0, "raster_ms": 40.0, "device": "cpu"},
        "train_seconds": 100.0,
        "experts": {"color": {"share": [0.6, 0.4], "mean_gate": [0.5, 0.5], "entropy": 0.97}},
        **other,
    }


@pytest.fixture
def runs(tmp_path: Path) -> list[Path]:
    out = []
    for name, value in (("a", results("scaffold-gs", 27.123)), ("b", results("moe-gs", 27.456))):
        (tmp_path / name).mkdir()
        (tmp_path / name / "results.json").write_text(json.dumps(value))
        out.append(tmp_path / name)
    return out


def printed(runs: list[Path], format: tables.Format = "table", mixed: bool = False, paper: str | None = None) -> str:
    console = Console(file=io.StringIO(), width=200)
    tables.compare_runs(runs, format, mixed, console, paper)
    return console.file.getvalue()  # type: ignore[attr-defined]


def test_markdown(runs: list[Path]) -> None:
    lines = printed(runs, "markdown").splitlines()
    assert lines[0].startswith("| run | PSNR | SSIM | LPIPS | LPIPS (3DGS) | MB |")
    assert lines[2].startswith("| scaffold-gs | 27.12 | **0.900** |") and lines[3].startswith("| moe-gs | **27.46** |")
    assert "12,345" in lines[2] and "36.5" in lines[2] and lines[1].count("---") == lines[0].count("|") - 1
    assert lines[-1].startswith("lpips_alex") and lines[-1].endswith("no weights: run this")


def test_a_bar_in_a_name_does_not_divide_a_markdown_row() -> None:
    table = tables.ResultTable(("recipe", "a|b"), (("x|y", "1.0"),), frozenset({(0, 1)}), ())
    assert tables.to_markdown(table) == "| recipe | a\\|b |\n|---|---:|\n| x\\|y | **1.0** |\n"


def test_csv_is_plain_numbers(runs: list[Path]) -> None:
    rows = list(csv.DictReader(io.StringIO(printed(runs, "csv"))))
    assert [r["run"] for r in rows] == ["scaffold-gs", "moe-gs"]
    assert float(rows[0]["PSNR"]) == 27.12 and float(rows[0]["anchors"]) == 12345


def test_terminal(runs: list[Path]) -> None:
    text = printed(runs)
    assert "yard" in text and "mod8" in text and "as-is" in text and "27.46" in text and "no weights: run this" in text


@pytest.mark.parametrize(
    ("key", "value", "option"),
    [
        ("capture", "garden", "--data"),
        ("resolution", "cap1600", "--resolution"),
        ("split", "first:31", "--split"),
        ("view_count", 8, "--max-views"),
        ("appearance", "half", "--appearance"),
    ],
)
def test_refuses_other_protocols(runs: list[Path], key: str, value: Any, option: str) -> None:
    (runs[1] / "results.json").write_text(json.dumps(results("moe-gs", 28.0, **{key: value})))
    with pytest.raises(InputError, match=naming(option, "--mixed")):
        printed(runs)
    assert "moe-gs on" in printed(runs, mixed=True)


def test_not_evaluated(tmp_path: Path, runs: list[Path]) -> None:
    with pytest.raises(InputError, match="scene-experts eval"):
        printed([*runs, tmp_path])
    for wrong in ("[1]", '{"psnr": null}'):
        (tmp_path / "results.json").write_text(wrong)
        with pytest.raises(InputError, match=naming("results.json")):
            printed([tmp_path])
    with pytest.raises(InputError):
        printed([])


def test_equal_recipes_are_told_apart_by_folder(runs: list[Path]) -> None:
    (runs[1] / "results.json").write_text(json.dumps(results("scaffold-gs", 27.0)))
    text = printed(runs, "markdown")
    assert "| a (scaffold-gs) |" in text and "| b (scaffold-gs) |" in text
    again = runs[0] / "deeper" / "a"
    again.mkdir(parents=True)
    (again / "results.json").write_text(json.dumps(results("scaffold-gs", 26.0)))
    text = printed([runs[0], again], "markdown")
    assert f"| {runs[0]} (scaffold-gs) |" in text and f"| {again} (scaffold-gs) |" in text


def test_beside_the_paper(runs: list[Path]) -> None:
    lines = printed(runs, "markdown", paper="DeepBlending").splitlines()
    row = next(line for line in lines if line.startswith("| MoE-GS (paper)"))
    assert [cell.strip(" *") for cell in row.split("|")][2:7] == ["30.64", "0.905", "-", "0.264", "55.4"]
    with pytest.raises(InputError, match="BungeeNeRF"):
        printed(runs, paper="nowhere")


def test_paper_numbers() -> None:
    assert tables.load_paper()["table2"]["BungeeNeRF"]["MoE-GS"] == [28.64, 0.925, 0.089, 161.6]
    assert tables.load_paper()["table3"]["Scaffold-GS"]["DeepBlending"] == 41.0
    for dataset in ("MipNeRF360", "DeepBlending", "TanksAndTemples", "BungeeNeRF"):
        assert len(tables.paper_results(dataset)) == 5


def test_print_results(tmp_path: Path) -> None:
    console = Console(file=io.StringIO(), width=200)
    tables.print_results(results("moe-gs", 27.5), console, tmp_path)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "27.50" in text and "detail" in text and "0.93" in text and str(tmp_path / "results.json") in text
    assert not any(word in text for word in ("entropy", "LPIPS (3DGS)", "active", "CPU s"))  # nobody can act on them after one run
    tables.print_results(results("moe-gs", 27.5, appearance="half"), console, tmp_path)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert "right halves" in text and str(tmp_path / "results_half.json") in text and "test_half" in text


def test_a_table_distinguishes_a_short_training_from_an_interrupted_one() -> None:
    short, cut = results("moe-gs", 27.0, step=7000, iterations=7000), results("moe-gs", 26.0, step=7000, iterations=30_000)
    made = tables.make_table(["short", "cut"], [short, cut])
    place = made.titles.index("iterations")
    assert made.titles[place + 1] == "of schedule" and [row[place : place + 2] for row in made.rows] == [
        ("7,000", "7,000"),
        ("7,000", "30,000"),
    ]


@pytest.mark.parametrize("width", [10, 40, 80, 200])
def test_no_cell_is_cut_in_a_narrow_terminal(runs: list[Path], width: int) -> None:
    console = Console(file=io.StringIO(), width=width)
    made = tables.compare_runs(runs, "table", False, console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    assert all(cell in text for cell in made.titles + made.rows[0] + made.rows[1]) and "\u2026" not in text
    lines = [line.rstrip() for line in text.splitlines()]
    straight = any(line.startswith("run ") and "PSNR" in line for line in lines)
    assert straight == (width == 200)
    assert width < 40 or max(map(len, lines)) <= max(width, len(made.notes[0]))  # the terminal wraps prose


def test_a_file_without_a_training_has_no_training_figures() -> None:
    trained = results("moe-gs", 27.0, step=4000, iterations=7000)
    imported = results("scaffold-gs", 26.0, step=0, iterations=0, train_seconds=0.0)
    found = tables.make_table(["a", "b"], [trained, imported])
    place = [found.titles.index(title) for title in ("iterations", "of schedule", "train s")]
    assert [found.rows[0][j] for j in place] == ["4,000", "7,000", "100"] and [found.rows[1][j] for j in place] == ["-"] * 3
    assert not {"iterations", "of schedule", "train s"} & set(tables.make_table(["b"], [imported]).titles)


def test_a_note_names_the_run_whose_score_is_absent():
    one, two = {"psnr": 1.0, "lpips": 0.2}, {"psnr": 2.0, "absent": {"lpips": "not asked for"}}
    assert tables.make_table(["a", "b"], [one, two]).notes == ("lpips of b absent: not asked for",)
    assert tables.make_table(["b"], [two]).notes == ("lpips absent: not asked for",)


def test_rows_are_called_anchors_or_gaussians() -> None:
    anchors, explicit = results("moe-gs", 27.0), results("3dgs", 26.0, activation_ratio=None)
    assert "anchors" in tables.make_table(["a"], [anchors]).titles and "Gaussians" in tables.make_table(["b"], [explicit]).titles
    assert "anchors or Gaussians" in tables.make_table(["a", "b"], [anchors, explicit]).titles


def test_scores_of_training_views_are_named_as_such() -> None:
    assert tables.make_table(["a"], [results("moe-gs", 30.0, views="train")]).titles[1] == "training PSNR"
    assert tables.make_table(["a"], [results("moe-gs", 30.0)]).titles[1] == "PSNR"


@pytest.mark.parametrize(
    "other",
    [
        {"ssim": "x"},
        {"size": {"MB": {}}},
        {"views": None, "view_count": []},
        {"absent": 3},
        {"absent": {"lpips": []}},
        {"step": True},
        {"fps": {"fps": [1]}},
    ],
)
def test_results_of_other_types_end_in_a_table_or_one_sentence(runs: list[Path], other: dict[str, Any]) -> None:
    value = results("moe-gs", 20.0, **other)
    (runs[0] / "results.json").write_text(json.dumps({k: v for k, v in value.items() if v is not None}))
    try:
        printed(runs[:1])
    except InputError as error:
        assert str(runs[0]) in str(error) and "\n" not in str(error)


def test_texts_of_results_cannot_steer_a_terminal(runs: list[Path]) -> None:
    hostile = "\x1b]0;title\x07[/red]\ud800"
    value = results(hostile, 20.0, capture=hostile, resolution=hostile, absent={hostile: hostile})
    (runs[0] / "results.json").write_text(json.dumps(value))
    for format in ("table", "markdown", "csv"):
        for mixed in (False, True):
            text = printed(runs[:1], format, mixed)
            assert "\x1b" not in text and "\ud800" not in text and "[/red]" in text


def test_a_few_held_out_views_are_said_to_show_little():
    few, many = ([{**results("moe-gs", 30.0), "view_count": count}] * 2 for count in (2, 9))
    assert any("2 held-out views" in note for note in tables.make_table(["a", "b"], few).notes)
    for made in (tables.make_table(["a", "b"], many), tables.make_table(["a"], few[:1])):
        assert not any("held-out views" in note for note in made.notes)
