"""Tables of several results beside each other, and beside the paper's numbers: for terminals, Markdown and CSV."""

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
from rich.console import Console
from rich.table import Table as RichTable
from rich.text import Text

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json

Format = Literal["table", "markdown", "csv"]
PROTOCOL = {  # what must be equal before scores may be compared: key in results.json, name, option that sets it
    "capture": ("capture", "--data"),
    "resolution": ("resolution", "--resolution"),
    "mean_pixels": ("picture size", "--resolution"),
    "split": ("split", "--split"),
    "views": ("views", "--views"),
    "view_count": ("number of views", "--max-views"),
    "appearance": ("appearance codes", "--appearance"),
    "masked": ("use of masks", "--data"),
}
UNSAID = {"appearance": "rule"}  # what a results file without the key means


@dataclass(frozen=True)
class Column:
    """One figure of a results file. `best`: which end is better, 0 where neither is."""

    title: str
    path: tuple[str, ...]
    digits: int = 0
    factor: float = 1.0
    best: int = 0
    counted: bool = False  # 0 says that nobody counted: a file of another program knows nothing of its training

    def value(self, results: dict[str, Any]) -> float | None:
        found: Any = results
        for key in self.path:
            found = found.get(key) if isinstance(found, dict) else None
        return None if found is None or (self.counted and not found) else float(found) * self.factor

    def text(self, value: float | None) -> str:
        return "-" if value is None else f"{value:,.{self.digits}f}"


COLUMNS = (
    Column("PSNR", ("psnr",), 2, best=1),
    Column("SSIM", ("ssim",), 3, best=1),
    Column("LPIPS", ("lpips",), 3, best=-1),
    Column("LPIPS (3DGS)", ("lpips_3dgs",), 3, best=-1),
    Column("LPIPS (Alex)", ("lpips_alex",), 3, best=-1),
    Column("MB", ("size", "MB"), 1, best=-1),
    Column("anchors", ("anchors",)),
    Column("active %", ("activation_ratio",), 1, 100.0),
    Column("sharpness", ("sharpness", "ratio"), 2),
    Column("FPS", ("fps", "fps"), 1, best=1),
    Column("iterations", ("step",), counted=True),
    Column("of schedule", ("iterations",), counted=True),  # the schedule's length: with fewer steps a training was cut off, not short
    Column("train s", ("train_seconds",), counted=True),
    Column("CPU s", ("cpu_seconds",), counted=True),
)


@dataclass(frozen=True)
class Table:
    """Cells as text, with the best of each column known by (row, column)."""

    titles: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    best: frozenset[tuple[int, int]] = frozenset()
    notes: tuple[str, ...] = ()


def load_results(run: Path, views: str = "test") -> dict[str, Any]:
    """results.json of a run folder. Raises InputError where the run was not evaluated."""
    path = run / ("results.json" if views == "test" else f"results_{views}.json")
    if run.is_file():
        path = run
    if not path.is_file():
        raise InputError(f"expected an evaluated run with {path.name} in {run}, found none; run `scene-experts eval {run}` first")
    results = read_json(path, "results file")
    if not isinstance(results, dict) or not isinstance(results.get("psnr"), (int, float)):
        raise InputError(f"expected results of `scene-experts eval` in {path}, found something else; evaluate the run again")
    return results


def outdated(names: Sequence[str], runs: Sequence[Path], results: Sequence[dict[str, Any]]) -> list[str]:
    """In a sentence each: the runs that were trained on after they were scored."""
    out = []
    for name, run, found in zip(names, runs, results):
        newest = max((int(p.stem[5:]) for p in (run / "checkpoints").glob("ckpt_*.safetensors") if p.stem[5:].isdigit()), default=0)
        if newest > (found.get("step") or newest):
            out.append(f"{name} was scored at iteration {found['step']:,} and is at {newest:,} now: run `scene-experts eval {run}` again")
    return out


def unlike(names: Sequence[str], results: Sequence[dict[str, Any]]) -> tuple[str, str] | None:
    """The first difference in what was scored, in words, and the option that sets it; None where scores may be compared."""
    for name, other in zip(names[1:], results[1:]):
        for key, (what, option) in PROTOCOL.items():
            ours, theirs = (r.get(key, UNSAID.get(key)) for r in (results[0], other))
            if ours != theirs:
                return f"the same {what}, found {ours} in {names[0]} and {theirs} in {name}", option
    return None


def check_protocol(names: Sequence[str], results: Sequence[dict[str, Any]]) -> None:
    """Raises InputError naming the first difference in what was scored: resolution alone moves PSNR by up to half a dB."""
    if found := unlike(names, results):
        raise InputError(
            f"expected runs with {found[0]}; repeat one with the other's {found[1]}, "
            f"or add --mixed to see them beside each other all the same"
        )


def table(names: Sequence[str], results: Sequence[dict[str, Any]], columns: Sequence[Column] = COLUMNS) -> Table:
    """One row per result. A column that no result has is left out; what is absent is "-" with its reason in the notes."""
    values = [[column.value(result) for column in columns] for result in results]
    used = [j for j in range(len(columns)) if any(row[j] is not None for row in values)]
    best: set[tuple[int, int]] = set()
    for place, j in enumerate(used):
        texts = {i: columns[j].text(row[j]) for i, row in enumerate(values) if row[j] is not None}
        if columns[j].best and len(texts) > 1:
            winner = max(texts, key=lambda i: columns[j].best * (values[i][j] or 0.0))
            best |= {(i, place + 1) for i, text in texts.items() if text == texts[winner]}
    rows = tuple((name, *(columns[j].text(row[j]) for j in used)) for name, row in zip(names, values))
    titles = tuple(columns[j].title if columns[j].path != ("anchors",) else _counted_as(results) for j in used)
    return Table(("run", *titles), rows, frozenset(best), _notes(names, results))


def _counted_as(results: Sequence[dict[str, Any]]) -> str:
    """What the rows of the scenes are: explicit scenes (which have no share of active Gaussians) hold Gaussians themselves."""
    explicit = {result.get("activation_ratio") is None for result in results if result.get("anchors") is not None}
    return "Gaussians" if explicit == {True} else "anchors" if explicit == {False} else "anchors or Gaussians"


def _notes(names: Sequence[str], results: Sequence[dict[str, Any]]) -> tuple[str, ...]:
    """Why scores are absent, each reason once with the scores it explains."""
    reasons: dict[str, list[str]] = {}
    for result in results:
        for metric, reason in (result.get("absent") or {}).items():
            if metric not in (known := reasons.setdefault(reason, [])):
                known.append(metric)
    lacking = {reason: [n for n, r in zip(names, results) if reason in (r.get("absent") or {}).values()] for reason in reasons}
    where = {reason: "" if len(of) == len(results) else f" of {', '.join(of)}" for reason, of in lacking.items()}
    return tuple(f"{', '.join(metrics)}{where[reason]} absent: {reason}" for reason, metrics in reasons.items())


def to_markdown(table: Table) -> str:
    """A Markdown table, the best of each column bold, notes below."""
    rows = [[f"**{cell}**" if (i, j) in table.best else cell for j, cell in enumerate(row)] for i, row in enumerate(table.rows)]
    lines = ["| " + " | ".join(table.titles) + " |", "|---|" + "---:|" * (len(table.titles) - 1)]
    lines += ["| " + " | ".join(row) + " |" for row in rows]
    return "\n".join(lines + ["", *table.notes] if table.notes else lines) + "\n"


def to_csv(table: Table) -> str:
    """Comma-separated values with a header; absent values are empty."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(table.titles)
    writer.writerows([row[0], *("" if cell == "-" else cell.replace(",", "") for cell in row[1:])] for row in table.rows)
    return out.getvalue()


def to_rich(table: Table, width: int) -> RichTable:
    """For a terminal `width` characters wide, the best of each column bold. Where that is too narrow, runs are columns; no cell is cut."""
    turned = Table(
        (table.titles[0], *(row[0] for row in table.rows)),
        tuple(zip(table.titles[1:], *(row[1:] for row in table.rows))),
        frozenset((j - 1, i + 1) for i, j in table.best),
    )
    if _width(table) > width and _width(turned) < _width(table):
        table = turned
    fixed = _width(table) if _width(table) > width else None  # lines longer than the terminal rather than cells with "..."
    drawn = RichTable(box=None, pad_edge=False, header_style="bold", width=fixed)
    for j, name in enumerate(table.titles):
        drawn.add_column(name, justify="left" if j == 0 else "right", no_wrap=True)
    for i, row in enumerate(table.rows):
        drawn.add_row(*(Text(cell, "bold" if (i, j) in table.best else "") for j, cell in enumerate(row)))
    return drawn


def _width(table: Table) -> int:
    """Characters of the longest line: the widest cell of each column, two blanks between columns."""
    return sum(max(map(len, column)) + 2 for column in zip(table.titles, *table.rows)) - 2


def row_names(runs: Sequence[Path], results: Sequence[dict[str, Any]]) -> list[str]:
    """Names by which a reader tells runs apart (`told_apart`), the recipes taken from their results."""
    return told_apart(runs, [str(result.get("recipe") or run.name) for run, result in zip(runs, results)])


def told_apart(runs: Sequence[Path], recipes: Sequence[str]) -> list[str]:
    """The recipe where it tells the runs apart, else the run folder's name with it, or the whole path where those are equal too."""
    for names in (list(recipes), [f"{run.resolve().name} ({recipe})" for run, recipe in zip(runs, recipes)]):
        if len(set(names)) == len(names):
            return names
    return [f"{run} ({recipe})" for run, recipe in zip(runs, recipes)]


def compare_runs(runs: Sequence[Path], format: Format, mixed: bool, console: Console, paper: str | None = None) -> Table:
    """Print one table of several evaluated runs, and of the paper's numbers for the data set `paper` below them.

    Raises InputError where they were scored on different captures, resolutions or splits, unless `mixed`.
    """
    if not runs:
        raise InputError("expected at least one run folder, found none; name the folders that `scene-experts train --out` wrote")
    results = [load_results(Path(run)) for run in runs]
    names = row_names([Path(run) for run in runs], results)
    if not mixed:
        check_protocol(names, results)
    else:
        names = [f"{name} on {result.get('capture')}, {result.get('resolution')}" for name, result in zip(names, results)]
    published = paper_results(paper) if paper else {}
    made = table([*names, *published], [*results, *published.values()])
    made = replace(made, notes=(*made.notes, *outdated(names, [Path(run) for run in runs], results)))
    if format == "table":
        if not mixed:
            console.print(_title(results[0]), markup=False, soft_wrap=True)
        console.print(to_rich(made, console.width), crop=False)
        for note in made.notes:
            console.print(note, markup=False, soft_wrap=True)
    else:
        console.print(to_markdown(made) if format == "markdown" else to_csv(made), markup=False, highlight=False, soft_wrap=True, end="")
    return made


def print_results(results: dict[str, Any], console: Console, run: Path) -> None:
    """Print what an evaluation found and where its pictures are."""

    def say(line: str) -> None:
        console.print(line, markup=False, soft_wrap=True)

    half = "_half" if results.get("appearance") == "half" else ""
    suffix = half or ("" if results["views"] == "test" else f"_{results['views']}")
    made = table([str(results.get("recipe") or run.name)], [results])
    say(_title(results))
    console.print(to_rich(made, console.width), crop=False)
    for note in made.notes:
        say(note)
    for attribute, shares in results["experts"].items():
        named, values = ("share", shares["share"]) if shares["share"] else ("mean gate", shares["mean_gate"])
        say(f"experts, {attribute}: {named} {' '.join(f'{v:.0%}' for v in values)}, gate entropy {shares['entropy']:.2f}")
    fps = results["fps"]
    say(f"drawing: {fps['decode_ms']:.1f} ms decode + {fps['raster_ms']:.1f} ms raster on {fps['device']}")
    say(f"wrote {run / f'results{suffix}.json'} and pictures in {run / (results['views'] + half) / 'side_by_side'}")


def _title(results: dict[str, Any]) -> str:
    """What the scores of a table are of."""
    part = "right halves of " if results.get("appearance") == "half" else ""
    return f"{results['capture']}: {part}{results['view_count']} {results['views']} views ({results['split']}), {results['resolution']}"


@cache
def paper() -> dict[str, Any]:
    """The MoE-GS paper's tables as data (paper.yaml)."""
    return yaml.safe_load(files("scene_experts.evaluate").joinpath("paper.yaml").read_text())


def paper_results(dataset: str) -> dict[str, dict[str, Any]]:
    """The paper's rows for a data set of its tables 1 and 2, by "<method> (paper)", shaped like results.json.

    Its LPIPS is in the convention of 3DGS and stands under lpips_3dgs. Raises InputError for a data set it has no table of.
    """
    tables = {**_datasets("table1"), **_datasets("table2")}
    if dataset not in tables:
        raise InputError(f"expected a data set of the paper ({', '.join(tables)}), found {dataset}; name one of those")
    out = {}
    for method, (psnr, ssim, lpips, megabytes) in tables[dataset].items():
        out[f"{method} (paper)"] = {"psnr": psnr, "ssim": ssim, "lpips_3dgs": lpips, "size": {"MB": megabytes}}
    return out


def _datasets(name: str) -> dict[str, dict[str, list[float]]]:
    return {dataset: rows for dataset, rows in paper()[name].items() if dataset != "columns"}
