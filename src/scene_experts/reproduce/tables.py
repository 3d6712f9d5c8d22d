"""Tables of an experiment with the spread over seeds and the paper's numbers, as Markdown, CSV and
LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from scene_experts.evaluate.tables import FEW_VIEWS, NOISE, ResultTable, load_paper, to_markdown
from scene_experts.reproduce.experiments import Experiment
from scene_experts.reproduce.plan import OWN
from scene_experts.reproduce.statistics import Mean, clock_of, complete_seeds, mean
from scene_experts.reproduce.store import Record
from scene_experts.training.config import Train


@dataclass(frozen=True)
class Column:
    """A column of a table. `best`: 1 where more is better, -1 where less is, 0 where neither is."""

    title: str
    digits: int
    best: int


COLUMNS = {
    "psnr": Column("PSNR", 2, 1),
    "ssim": Column("SSIM", 3, 1),
    "lpips_3dgs": Column("LPIPS (3DGS)", 3, -1),
    "lpips": Column("LPIPS", 3, -1),
    "detail": Column("detail", 2, 1),
    "size_mb": Column("MB", 1, -1),
    "anchors": Column("anchors", 0, 0),
    "gaussians_rendered": Column("Gaussians drawn a view", 0, 0),
    "active_percent": Column("active %", 1, 0),
    "train_seconds": Column("training, wall s", 0, 0),
    "cpu_seconds": Column("training, CPU s", 0, -1),
}


def rows_of(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str]) -> dict[str, list[Record]]:
    """Return the records of each row on the given scenes."""
    return {name: [r for r in records if r.recipe == recipe and r.scene in scenes] for name, recipe in experiment.rows.items()}


def cases(records: Sequence[Record], column: str | None = None) -> set[tuple[str, int]]:
    """Return the pairs of scene and seed that a mean covers: of the records, or of those with a
    value of a column."""
    return {(r.scene, r.seed) for r in records if column is None or r.value(column) is not None}


def by_dataset(experiment: Experiment, records: Sequence[Record], dataset: str, scenes: Sequence[str]) -> ResultTable:
    """Make the table with one row per method and means over `scenes`: our columns, then the paper's
    where it has this data set."""
    found = rows_of(experiment, records, scenes)
    theirs = paper_numbers(experiment, dataset)
    together = [r for some in found.values() for r in some]
    columns = columns_of(experiment, together)
    titles = ["", *(COLUMNS[c].title for c in columns)]
    titles += [f"{COLUMNS[c].title} (paper)" for c in experiment.columns] if theirs else []
    rows, values = [], []
    every = [cases(together, c) for c in columns]
    for name in experiment.rows:
        means = [mean(found[name], c) for c in columns]
        fair = [cases(found[name], c) == whole for c, whole in zip(columns, every)]  # means over other scenes or seeds are not marked
        values.append([m.value if m and f else None for m, f in zip(means, fair)])
        cells = [text(m, c) for m, c in zip(means, columns)]
        if theirs:
            numbers = theirs.get(name)
            cells += (
                [f"{v:.{COLUMNS[c].digits}f}" for v, c in zip(numbers, experiment.columns)] if numbers else ["-"] * len(experiment.columns)
            )
        rows.append((name, *cells))
    said = notes(found) + lacking_notes(found, columns) + (time_notes(together) if {"train_seconds", "cpu_seconds"} & set(columns) else ())
    return ResultTable(tuple(titles), tuple(rows), best(values, columns), said)


def columns_of(experiment: Experiment, records: Sequence[Record]) -> list[str]:
    """Return the columns of a table of these records: "time" as CPU or wall time, and `added`
    columns that every record has."""
    own = [clock_of(records) if c == "time" else c for c in experiment.columns]
    return own + [c for c in experiment.added if records and all(r.value(c) is not None for r in records)]


def by_scene(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str]) -> ResultTable:
    """Make the table of the experiment's first column (PSNR as a rule), one row per method and one
    column per scene."""
    found, column = rows_of(experiment, records, scenes), experiment.columns[0]
    rows, values = [], []
    every = {scene: {r.seed for some in found.values() for r in some if r.scene == scene} for scene in scenes}
    for name in experiment.rows:
        here = [[r for r in found[name] if r.scene == scene] for scene in scenes]
        means = [mean(some, column) for some in here]
        fair = [{r.seed for r in some} == every[scene] for some, scene in zip(here, scenes)]
        values.append([m.value if m and f else None for m, f in zip(means, fair)])
        rows.append((name, *(text(m, column) for m in means)))
    return ResultTable((COLUMNS[column].title, *scenes), tuple(rows), best(values, [column] * len(scenes)))


def expert_shares(experiment: Experiment, records: Sequence[Record], scene: str) -> ResultTable | None:
    """Make the table of each expert's share of all N anchors at the end of the training, in %: of
    the N k assignments, then of the anchors.

    Uses the first seed. None where no row has experts on this scene.
    """
    rows: list[tuple[str, ...]] = []
    for name, recipe in experiment.rows.items():
        record = min((r for r in records if r.recipe == recipe and r.scene == scene), key=lambda r: r.seed, default=None)
        for attribute, found in (record.results.get("experts") or {}).items() if record else ():
            if found["share"]:
                cells = [*found["share"], *found["per_anchor"]]
                rows.append((f"{name}: {attribute}", *(f"{100 * cell:.1f}" for cell in cells), f"{found['entropy']:.2f}"))
    if not rows:
        return None
    experts = range(1, len(rows[0]) // 2)
    titles = ("", *(f"expert {e}" for e in experts), *(f"expert {e}, of anchors" for e in experts), "gate entropy")
    return ResultTable(titles, tuple(rows))


def paper_numbers(experiment: Experiment, dataset: str) -> dict[str, list[float]]:
    """Return the paper's numbers of a data set by row; empty where it has none."""
    if experiment.paper is None or dataset == OWN:
        return {}
    section = load_paper()[experiment.paper]
    if "columns" in section:
        return section.get(dataset, {})
    return {name: [numbers[dataset]] for name, numbers in section.items() if dataset in numbers}


def text(value: Mean | None, column: str) -> str:
    """Format a mean, and its spread where there is one."""
    if value is None:
        return "-"
    digits = COLUMNS[column].digits
    return f"{value.value:.{digits}f}" + ("" if value.spread is None else f" ± {value.spread:.{digits}f}")


def best(values: list[list[float | None]], columns: Sequence[str]) -> frozenset[tuple[int, int]]:
    """Return the best cells of each of our columns, as (row, column of the table): all that read as
    the best one does."""
    out = set()
    for j, column in enumerate(columns):
        present = {i: value for i, row in enumerate(values) if (value := row[j]) is not None}
        sign, digits = COLUMNS[column].best, COLUMNS[column].digits
        if sign and len(present) > 1:
            winner = f"{sign * max(sign * value for value in present.values()):.{digits}f}"
            out |= {(i, j + 1) for i, value in present.items() if f"{value:.{digits}f}" == winner}
    return frozenset(out)


def notes(found: dict[str, list[Record]]) -> tuple[str, ...]:
    """Write the notes of a table: iterations, resolution, seeds, and the runs that rows lack."""
    records = [r for rows in found.values() for r in rows]
    if not records:
        return ("No run of this table is finished.",)
    lengths: dict[int, set[int | None]] = {}
    for r in records:
        lengths.setdefault(r.config.train.iterations, set()).add(densifications(r.config.train))
    sizes = sorted({r.config.data.resolution for r in records})
    seeds = sorted({r.seed for r in records})
    made = ", ".join(f"{n:,} iterations{bracket(counts)}" for n, counts in sorted(lengths.items()))
    out = [f"{made}; resolution {', '.join(sizes)}; seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}."]
    views = {r.scene: r.results["view_count"] for r in records if r.results.get("view_count")}
    if views:
        out.append(f"Held-out views: {', '.join(f'{scene} {count}' for scene, count in views.items())}.")
    if few := [scene for scene, count in views.items() if count < FEW_VIEWS]:
        out.append(f"So few views ({', '.join(few)}) make means and intervals unreliable: differences below {NOISE} dB show nothing there.")
    for name, rows in found.items():
        whole = sorted(complete_seeds(rows))
        if rows and whole != seeds:
            counted = f"mean over seeds {', '.join(map(str, whole))}; other seeds lack scenes" if whole else "no seed has every scene"
            out.append(f"{name}: {counted}.")
    every, none = cases(records), [name for name, rows in found.items() if not rows]
    for name, rows in found.items():
        scenes = {r.scene for r in rows}
        lacking = sorted({scene for scene, _ in every} - scenes)
        if rows and lacking:
            out.append(f"{name}: no run on {', '.join(lacking)}.")
        for seed in seeds:
            fewer = sorted(scene for scene, s in every - cases(rows) if s == seed and scene in scenes)
            if fewer:
                out.append(f"{name}: no run with seed {seed}{'' if set(fewer) == scenes else ' on ' + ', '.join(fewer)}.")
    if none:
        out.append(f"No run: {'; '.join(none)}.")
    return tuple(out)


def lacking_notes(found: dict[str, list[Record]], columns: Sequence[str]) -> tuple[str, ...]:
    """Write a note for each mean that leaves runs out because they have no value, such as LPIPS
    where its weights were absent."""
    out = []
    for name, records in found.items():
        for column in columns:
            known = cases(records, column)
            if known and (lacking := sorted(cases(records) - known)):
                out.append(f"{name}: no {COLUMNS[column].title} of {', '.join(f'{scene} (seed {seed})' for scene, seed in lacking)}.")
    return tuple(out)


def time_notes(records: Sequence[Record]) -> tuple[str, ...]:
    """Write the notes of a column of training times: which time it is, and the load of the
    machine."""
    if clock_of(records) == "cpu_seconds":
        out = ["Training times are CPU times of all threads of the training loop."]
    else:
        out = ["Training times are wall times, which other work on the machine lengthens: not every record has the CPU time."]
    known = [load for r in records if None not in ((load := r.results.get("load") or {}).get("start"), load.get("end"), load.get("cores"))]
    if known and len(known) == len(records):
        averages = [load[when] for load in known for when in ("start", "end")]
        cores = sorted({load["cores"] for load in known})
        out.append(f"The load average was {min(averages):.1f} to {max(averages):.1f} on {' or '.join(map(str, cores))} cores.")
    return tuple(out)


def densifications(train: Train) -> int | None:
    """Return the number of densification steps. Shorter trainings densify at the same interval, so
    less often in total."""
    return train.scaled().growth.count_steps(train.iterations)


def count_range(counts: Iterable[int | None]) -> str:
    """Write the numbers of densification steps as "13" or "13 to 17"; empty where a growth rule
    does not say."""
    known = [n for n in counts if n is not None]
    return " to ".join(str(n) for n in sorted({min(known), max(known)})) if known else ""


def bracket(counts: Iterable[int | None]) -> str:
    """Write the numbers of densification steps in brackets, or nothing."""
    return f" ({text} densification steps)" if (text := count_range(counts)) else ""


def to_latex(table: ResultTable, caption: str) -> str:
    """Format a booktabs table with the best cell of each column in bold."""
    rows = [
        [rf"\textbf{{{escape(c)}}}" if (i, j) in table.best else escape(c) for j, c in enumerate(row)] for i, row in enumerate(table.rows)
    ]
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{escape(caption)}}}", rf"\begin{{tabular}}{{l{'r' * (len(table.titles) - 1)}}}"]
    lines += [r"\toprule", " & ".join(escape(t) for t in table.titles) + r" \\", r"\midrule"]
    lines += [" & ".join(row) + r" \\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in table.notes), r"\end{table}"]
    return "\n".join(lines) + "\n"


def escape(cell: str) -> str:
    """Escape what LaTeX would interpret."""
    for old, new in (("\\", r"\textbackslash "), ("$", r"\$"), ("_", r"\_"), ("%", r"\%"), ("&", r"\&"), ("#", r"\#"), ("±", r"$\pm$")):
        cell = cell.replace(old, new)
    return cell.replace("--", "-{}-")  # two hyphens of a flag, not a dash


def to_csv(tables: dict[str, ResultTable]) -> str:
    """Format one line per cell: table, row, column, value, spread over seeds. Empty cells are left
    out."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(("table", "row", "column", "value", "spread"))
    for name, table in tables.items():
        for row in table.rows:
            for title, cell in zip(table.titles[1:], row[1:]):
                value, _, spread = cell.partition(" ± ")
                if value != "-":
                    writer.writerow((name, row[0], f"{table.titles[0]} {title}".strip(), value, spread))
    return out.getvalue()


def write_all(title: str, tables: dict[str, ResultTable]) -> dict[str, str]:
    """Return the text of the files of an experiment by suffix: md, csv and tex, each with all its
    tables."""
    markdown = f"# {title}\n\n" + "\n".join(f"## {name}\n\n{to_markdown(table)}" for name, table in tables.items())
    return {
        "md": markdown,
        "csv": to_csv(tables),
        "tex": "\n".join(to_latex(table, f"{title}. {name}") for name, table in tables.items()),
    }
