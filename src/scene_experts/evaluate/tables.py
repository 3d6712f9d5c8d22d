"""Tables of the results of several runs, and of the paper's numbers, for terminals, in Markdown and
in CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import yaml
from rich import table as rich_table
from rich.console import Console
from rich.text import Text

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.source import guarding, sentence
from scene_experts.evaluate.alignment import ALIGNED_SHORT
from scene_experts.evaluate.results import check_protocol, describe_failed, find_outdated, load_results

Format = Literal["table", "markdown", "csv"]


@dataclass(frozen=True)
class ResultColumn:
    """A value of a results file that is one column of a table."""

    title: str
    path: tuple[str, ...]  # keys in results.json
    digits: int = 0  # after the decimal point
    factor: float = 1.0
    best: int = 0  # 1: larger is better; -1: smaller is better; 0: neither
    counted: bool = False  # 0 means unknown, e.g. for a file of another program
    about: str = ""  # what it is, in a sentence for people who do not know it
    research: bool = False  # for comparisons of methods: left out of the terminal's table of one run

    def value(self, results: dict[str, Any]) -> float | None:
        """Return the value in `results`, or None if it is absent."""
        found: Any = results
        for key in self.path:
            found = found.get(key) if isinstance(found, dict) else None
        return None if found is None or (self.counted and not found) else float(found) * self.factor

    def text(self, value: float | None) -> str:
        """Format a value; "-" stands for an absent one."""
        return "-" if value is None else f"{value:,.{self.digits}f}"


FEW_VIEWS = 5  # with fewer held-out views, means are unreliable
NOISE = 0.7  # dB; how far seeds and the order of the views move the PSNR of one run (3,000 iterations)
COLUMNS = (
    ResultColumn(
        "PSNR", ("psnr",), 2, best=1,
        about="likeness of pixels in decibels. Higher is better: 20 is rough, 25 good, over 30 hard to tell apart.",
    ),
    ResultColumn("SSIM", ("ssim",), 3, best=1, about="likeness of local structure, at most 1. Higher is better."),
    ResultColumn(
        "LPIPS", ("lpips",), 3, best=-1,
        about="difference as a network (VGG) perceives it; 0 is equal. Lower is better. It punishes blur more than PSNR does.",
    ),
    ResultColumn(
        "LPIPS (3DGS)", ("lpips_3dgs",), 3, best=-1, research=True,
        about="LPIPS as the code of 3DGS computes it, for comparison with papers.",
    ),
    ResultColumn("LPIPS (Alex)", ("lpips_alex",), 3, best=-1, research=True, about="LPIPS with another network (AlexNet)."),
    ResultColumn("MB", ("size", "MB"), 1, best=-1, about="size of the scene with its networks, in millions of bytes."),
    ResultColumn("anchors", ("anchors",), about="elements that the scene stores. A network turns each anchor into several Gaussians."),
    ResultColumn(
        "active %", ("activation_ratio",), 1, 100.0, research=True, about="share of the decoded Gaussians whose opacity is positive."
    ),
    ResultColumn(
        "detail", ("detail",), 2, best=1,
        about="share of the photographs' fine detail that the renders have; 1 is all of it. Specks and noise do not count.",
    ),
    ResultColumn("FPS", ("fps", "fps"), 1, best=1, about="pictures drawn per second on the machine that scored the run."),
    ResultColumn("iterations", ("step",), counted=True, about="training steps until the scored checkpoint."),
    ResultColumn(
        "of schedule", ("iterations",), counted=True, research=True,  # fewer iterations mean an interrupted training
        about="training steps that were planned.",
    ),
    ResultColumn("train s", ("train_seconds",), counted=True, about="wall time of the training in seconds."),
    ResultColumn(
        "CPU s", ("cpu_seconds",), counted=True, research=True, about="processor time of the training in seconds, over all threads."
    ),
)  # fmt: skip


@dataclass(frozen=True)
class ResultTable:
    """A table of text. `best` holds the (row, column) of the best cells of each column."""

    titles: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    notes: tuple[str, ...] = ()


def make_table(names: Sequence[str], results: Sequence[dict[str, Any]], columns: Sequence[ResultColumn] = COLUMNS) -> ResultTable:
    """Make a table with one row per result. Columns without values are omitted; notes explain
    absent scores."""
    values = [[column.value(result) for column in columns] for result in results]
    used = [j for j in range(len(columns)) if any(row[j] is not None for row in values)]
    best: set[tuple[int, int]] = set()
    for place, j in enumerate(used):
        texts = {i: columns[j].text(row[j]) for i, row in enumerate(values) if row[j] is not None}
        if columns[j].best and len(texts) > 1:
            winner = max(texts, key=lambda i: columns[j].best * (values[i][j] or 0.0))
            best |= {(i, place + 1) for i, text in texts.items() if text == texts[winner]}
    rows = tuple((name, *(columns[j].text(row[j]) for j in used)) for name, row in zip(names, values))
    names_of: dict[tuple[str, ...], str] = {("anchors",): _name_scene_rows(results)}
    if results and all(result.get("views") == "train" for result in results):
        names_of[("psnr",)] = "training PSNR"
    titles = tuple(names_of.get(columns[j].path, columns[j].title) for j in used)
    return ResultTable(("run", *titles), rows, frozenset(best), (*_explain_absent(names, results), *_warn_of_few_views(results)))


def explain(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Return the titles that have an explanation, each with it."""
    known = {column.title: column.about for column in COLUMNS}
    known |= {"Gaussians": "elements that the scene stores and draws.", "training PSNR": "PSNR of photographs that were trained on."}
    known["anchors or Gaussians"] = known["anchors"]
    return [(title, known[title]) for title in titles if known.get(title)]


def _name_scene_rows(results: Sequence[dict[str, Any]]) -> str:
    """Return what the rows of the scenes are called. Results without an activation ratio belong to
    explicit Gaussians."""
    explicit = {result.get("activation_ratio") is None for result in results if result.get("anchors") is not None}
    return "Gaussians" if explicit == {True} else "anchors" if explicit == {False} else "anchors or Gaussians"


def _explain_absent(names: Sequence[str], results: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Return a note for each reason why scores are absent, with the scores that it explains."""
    reasons: dict[str, list[str]] = {}
    for result in results:
        for metric, reason in (result.get("absent") or {}).items():
            if metric not in (known := reasons.setdefault(reason, [])):
                known.append(metric)
    lacking = {reason: [n for n, r in zip(names, results) if reason in (r.get("absent") or {}).values()] for reason in reasons}
    where = {reason: "" if len(of) == len(results) else f" of {', '.join(of)}" for reason, of in lacking.items()}
    return tuple(sentence(f"{', '.join(metrics)}{where[reason]} absent: {reason}") for reason, metrics in reasons.items())


def _warn_of_few_views(results: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Return a note where so few held-out views were scored that differences between runs are
    chance."""
    counts = [count for result in results if (count := result.get("view_count")) and result.get("views") != "train"]
    if len(counts) < 2 or min(counts) >= FEW_VIEWS:
        return ()
    return (f"Only {min(counts)} held-out views, one run in each row: differences below {NOISE} dB show nothing.",)


def to_markdown(table: ResultTable) -> str:
    """Return a Markdown table with the best of each column in bold and the notes below."""
    rows = [[cell.replace("|", "\\|") for cell in row] for row in table.rows]
    rows = [[f"**{cell}**" if (i, j) in table.best else cell for j, cell in enumerate(row)] for i, row in enumerate(rows)]
    titles = (title.replace("|", "\\|") for title in table.titles)
    lines = ["| " + " | ".join(titles) + " |", "|---|" + "---:|" * (len(table.titles) - 1)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines + ["", *table.notes] if table.notes else lines) + "\n"


def to_csv(table: ResultTable) -> str:
    """Return comma-separated values with a header. Absent values are empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table.titles)
    writer.writerows([row[0], *("" if cell == "-" else cell.replace(",", "") for cell in row[1:])] for row in table.rows)
    return out.getvalue()


def to_rich(table: ResultTable, width: int) -> rich_table.Table:
    """Return a table for a terminal of `width` characters with the best of each column in bold.

    If it is too wide, runs become columns. No cell is truncated.
    """
    turned = ResultTable(
        (table.titles[0], *(row[0] for row in table.rows)),
        tuple(zip(table.titles[1:], *(row[1:] for row in table.rows))),
        frozenset((j - 1, i + 1) for i, j in table.best),
    )
    if _measure_width(table) > width and _measure_width(turned) < _measure_width(table):
        table = turned
    fixed = (
        _measure_width(table) if _measure_width(table) > width else None
    )  # lines may be longer than the terminal; cells are not truncated
    drawn = rich_table.Table(box=None, pad_edge=False, header_style="bold", width=fixed)
    for j, name in enumerate(table.titles):
        drawn.add_column(name, justify="left" if j == 0 else "right", no_wrap=True)
    for i, row in enumerate(table.rows):
        drawn.add_row(*(Text(cell, "bold" if (i, j) in table.best else "") for j, cell in enumerate(row)))
    return drawn


def _measure_width(table: ResultTable) -> int:
    """Return the length of the longest line in characters, with two blanks between columns."""
    return sum(max(map(len, column)) + 2 for column in zip(table.titles, *table.rows)) - 2


def name_runs(runs: Sequence[Path], results: Sequence[dict[str, Any]]) -> list[str]:
    """Return a distinct name for each run from the recipe in its results, see
    `distinguish_runs`."""
    return distinguish_runs(runs, [sentence(result.get("recipe") or run.name) for run, result in zip(runs, results)])


def distinguish_runs(runs: Sequence[Path], recipes: Sequence[str]) -> list[str]:
    """Return a distinct name for each run: the recipe, or the name of the run folder with it, or
    the whole path with it."""
    for names in (list(recipes), [f"{run.resolve().name} ({recipe})" for run, recipe in zip(runs, recipes)]):
        if len(set(names)) == len(names):
            return names
    return [f"{run} ({recipe})" for run, recipe in zip(runs, recipes)]


def compare_runs(runs: Sequence[Path], format: Format, mixed: bool, console: Console, paper: str | None = None) -> ResultTable:
    """Print a table of evaluated runs, followed by the paper's numbers for the data set `paper`,
    and return it.

    Raises InputError if the runs were scored on different photographs (see `check_protocol`),
    unless `mixed` is set.
    """
    if not runs:
        raise InputError("expected at least one run folder, found none; give the folders that `scene-experts train --out` wrote")
    with guarding(runs[0] if len(runs) == 1 else "one of the runs", RUN):  # the files of a run may hold anything
        results = [load_results(Path(run), training=True) for run in runs]
        names = name_runs([Path(run) for run in runs], results)
        if not mixed:
            check_protocol(names, results)
        else:
            names = [sentence(f"{name} on {result.get('capture')}, {result.get('resolution')}") for name, result in zip(names, results)]
        published = paper_results(paper) if paper else {}
        made = make_table([*names, *published], [*results, *published.values()])
        made = replace(made, notes=(*made.notes, *find_outdated(names, [Path(run) for run in runs], results)))
        protocol = "" if mixed else _describe_protocol(results[0])
    if format == "table":
        if protocol:
            console.print(protocol, markup=False, soft_wrap=True)
        console.print(to_rich(made, console.width), crop=False)
        for note in made.notes:
            console.print(note, markup=False, soft_wrap=True)
    else:
        console.print(to_markdown(made) if format == "markdown" else to_csv(made), markup=False, highlight=False, soft_wrap=True, end="")
    return made


def print_results(results: dict[str, Any], console: Console, run: Path) -> None:
    """Print the results of an evaluation and where its pictures are. What only comparisons of
    methods need is in results.json, in the report and in `compare`."""

    def say(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    half = "_half" if results.get("appearance") == "half" else ""
    suffix = half or ("" if results["views"] == "test" else f"_{results['views']}")
    made = make_table([str(results.get("recipe") or run.name)], [results], [column for column in COLUMNS if not column.research])
    say(_describe_protocol(results))
    console.print(to_rich(made, console.width), crop=False)
    for note in made.notes:
        say(note)
    path = run / f"per_view{suffix}.json"
    if failed := describe_failed(read_json(path, "scores by view")) if path.is_file() else "":
        say(f"warning: {failed}")
    say(f"wrote {run / f'results{suffix}.json'} and pictures in {run / (results['views'] + half) / 'side_by_side'}")


def _describe_protocol(results: dict[str, Any]) -> str:
    """Return what was scored, in words."""
    part = "right halves of " if results.get("appearance") == "half" else ""
    views = f"{part}{results['view_count']} {results['views']} views"
    aligned = f", {ALIGNED_SHORT}" if results.get("alignment") else ""
    return sentence(f"{results['capture']}: {views} ({results['split']}), {results['resolution']}{aligned}")


@cache
def load_paper() -> dict[str, Any]:
    """Return the tables of the MoE-GS paper as data (paper.yaml)."""
    return yaml.safe_load(files("scene_experts.evaluate").joinpath("paper.yaml").read_text())


def paper_results(dataset: str) -> dict[str, dict[str, Any]]:
    """Return the paper's results for a data set of its tables 1 and 2, by "<method> (paper)" and
    shaped like results.json.

    Its LPIPS follows the convention of 3DGS and is `lpips_3dgs`. Raises InputError for a data set
    without a table.
    """
    tables = {**_select_datasets("table1"), **_select_datasets("table2")}
    if dataset not in tables:
        raise InputError(f"expected a data set of the paper ({', '.join(tables)}), found {dataset}; choose one of those")
    out = {}
    for method, (psnr, ssim, lpips, megabytes) in tables[dataset].items():
        out[f"{method} (paper)"] = {"psnr": psnr, "ssim": ssim, "lpips_3dgs": lpips, "size": {"MB": megabytes}}
    return out


def _select_datasets(name: str) -> dict[str, dict[str, list[float]]]:
    return {dataset: rows for dataset, rows in load_paper()[name].items() if dataset != "columns"}
