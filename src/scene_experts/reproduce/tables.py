"""An experiment's tables: ours with the spread over seeds, the paper's numbers beside them; Markdown, CSV and LaTeX."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass

from scene_experts.evaluate.tables import Table, paper, to_markdown
from scene_experts.reproduce.experiments import Experiment
from scene_experts.reproduce.plan import OWN
from scene_experts.reproduce.statistics import Mean, mean, whole_seeds
from scene_experts.reproduce.store import Record
from scene_experts.training.config import Train


@dataclass(frozen=True)
class Column:
    title: str
    digits: int
    best: int  # which end is better


COLUMNS = {
    "psnr": Column("PSNR", 2, 1),
    "ssim": Column("SSIM", 3, 1),
    "lpips_3dgs": Column("LPIPS", 3, -1),
    "size_mb": Column("MB", 1, -1),
    "active_percent": Column("active %", 1, 0),
    "train_seconds": Column("training s", 0, -1),
}


def rows_of(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str]) -> dict[str, list[Record]]:
    """The records of each row, on the given scenes."""
    return {name: [r for r in records if r.recipe == recipe and r.scene in scenes] for name, recipe in experiment.rows.items()}


def drawn(records: Sequence[Record]) -> set[tuple[str, int]]:
    """What a mean is over: scenes and seeds."""
    return {(r.scene, r.seed) for r in records}


def by_dataset(experiment: Experiment, records: Sequence[Record], dataset: str, scenes: Sequence[str]) -> Table:
    """One row per method: our columns, then the paper's for this data set where it has them. Means over `scenes`."""
    found = rows_of(experiment, records, scenes)
    theirs = published(experiment, dataset)
    titles = ["", *(COLUMNS[c].title for c in experiment.columns)]
    titles += [f"{COLUMNS[c].title} (paper)" for c in experiment.columns] if theirs else []
    rows, values = [], []
    every = drawn([r for some in found.values() for r in some])
    for name in experiment.rows:
        means = [mean(found[name], c) for c in experiment.columns]
        fair = drawn(found[name]) == every  # a mean over fewer scenes or other seeds is no rival
        values.append([m.value if m and fair else None for m in means])
        cells = [text(m, c) for m, c in zip(means, experiment.columns)]
        if theirs:
            numbers = theirs.get(name)
            cells += (
                [f"{v:.{COLUMNS[c].digits}f}" for v, c in zip(numbers, experiment.columns)] if numbers else ["-"] * len(experiment.columns)
            )
        rows.append((name, *cells))
    return Table(tuple(titles), tuple(rows), best(values, experiment.columns), notes(found))


def by_scene(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str]) -> Table:
    """PSNR (or the experiment's first column) of each method on each scene."""
    found, column = rows_of(experiment, records, scenes), experiment.columns[0]
    rows, values = [], []
    every = {scene: {r.seed for some in found.values() for r in some if r.scene == scene} for scene in scenes}
    for name in experiment.rows:
        here = [[r for r in found[name] if r.scene == scene] for scene in scenes]
        means = [mean(some, column) for some in here]
        fair = [{r.seed for r in some} == every[scene] for some, scene in zip(here, scenes)]
        values.append([m.value if m and f else None for m, f in zip(means, fair)])
        rows.append((name, *(text(m, column) for m in means)))
    return Table((COLUMNS[column].title, *scenes), tuple(rows), best(values, [column] * len(scenes)))


def expert_shares(experiment: Experiment, records: Sequence[Record], scene: str) -> Table | None:
    """How each attribute's experts share the whole scene at the end: % of the assignments (of N k, then of the N anchors), first seed.

    None where no row has experts there.
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
    return Table(titles, tuple(rows))


def published(experiment: Experiment, dataset: str) -> dict[str, list[float]]:
    """The paper's numbers by row for a data set; empty where it prints none."""
    if experiment.paper is None or dataset == OWN:
        return {}
    section = paper()[experiment.paper]
    if "columns" in section:
        return section.get(dataset, {})
    return {name: [numbers[dataset]] for name, numbers in section.items() if dataset in numbers}


def text(value: Mean | None, column: str) -> str:
    """A mean, and its spread where several seeds give one."""
    if value is None:
        return "-"
    digits = COLUMNS[column].digits
    return f"{value.value:.{digits}f}" + ("" if value.spread is None else f" ± {value.spread:.{digits}f}")


def best(values: list[list[float | None]], columns: Sequence[str]) -> frozenset[tuple[int, int]]:
    """The best cell of each of our columns, as (row, column of the table)."""
    out = set()
    for j, column in enumerate(columns):
        present = [(row[j], i) for i, row in enumerate(values) if row[j] is not None]
        if COLUMNS[column].best and len(present) > 1:
            out.add((max(present, key=lambda pair: COLUMNS[column].best * pair[0])[1], j + 1))  # type: ignore[operator]
    return frozenset(out)


def notes(found: dict[str, list[Record]]) -> tuple[str, ...]:
    """What the reader must know: seeds, iterations, resolution; rows that lack a scene."""
    records = [r for rows in found.values() for r in rows]
    if not records:
        return ("no run of this table is done",)
    lengths: dict[int, set[int]] = {}
    for r in records:
        lengths.setdefault(r.config.train.iterations, set()).add(adjustments(r.config.train))
    sizes = sorted({r.config.data.resolution for r in records})
    seeds = sorted({r.seed for r in records})
    between = {n: " to ".join(str(m) for m in sorted({min(many), max(many)})) for n, many in lengths.items()}
    made = ", ".join(f"{n:,} iterations ({many} adjustments of density)" for n, many in sorted(between.items()))
    out = [f"{made}; resolution {', '.join(sizes)}; seeds {', '.join(map(str, seeds))}"]
    for name, rows in found.items():
        whole = sorted(whole_seeds(rows))
        if rows and whole != seeds:
            counted = f"means of seeds {', '.join(map(str, whole))}, the others lack scenes" if whole else "no seed has every scene"
            out.append(f"{name}: {counted}")
    every, none = drawn(records), [name for name, rows in found.items() if not rows]
    for name, rows in found.items():
        scenes = {r.scene for r in rows}
        lacking = sorted({scene for scene, _ in every} - scenes)
        if rows and lacking:
            out.append(f"{name}: no run on {', '.join(lacking)}")
        fewer = sorted((scene, seed) for scene, seed in every - drawn(rows) if scene in scenes)
        if fewer:
            out.append(f"{name}: no run on {', '.join(f'{scene} with seed {seed}' for scene, seed in fewer)}")
    if none:
        out.append(f"no run: {'; '.join(none)}")
    return tuple(out)


def adjustments(train: Train) -> int:
    """How often density control acts: a short training adjusts as often per iteration, so more rarely in all."""
    return train.scaled().growth.adjust.count(train.iterations)


def to_latex(table: Table, caption: str) -> str:
    """A booktabs table, the best of each column bold."""
    rows = [
        [rf"\textbf{{{escape(c)}}}" if (i, j) in table.best else escape(c) for j, c in enumerate(row)] for i, row in enumerate(table.rows)
    ]
    lines = [r"\begin{table}", r"\centering", rf"\caption{{{escape(caption)}}}", rf"\begin{{tabular}}{{l{'r' * (len(table.titles) - 1)}}}"]
    lines += [r"\toprule", " & ".join(escape(t) for t in table.titles) + r" \\", r"\midrule"]
    lines += [" & ".join(row) + r" \\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}", *(f"% {note}" for note in table.notes), r"\end{table}"]
    return "\n".join(lines) + "\n"


def escape(cell: str) -> str:
    for old, new in (("\\", r"\textbackslash "), ("_", r"\_"), ("%", r"\%"), ("&", r"\&"), ("#", r"\#"), ("±", r"$\pm$")):
        cell = cell.replace(old, new)
    return cell


def to_csv(tables: dict[str, Table]) -> str:
    """One line a cell: table, row, column, value, spread over seeds. What is absent is left out."""
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


def write_all(title: str, tables: dict[str, Table]) -> dict[str, str]:
    """Files of an experiment by ending: one Markdown page, one CSV, one LaTeX file, its tables one after the other."""
    markdown = f"# {title}\n\n" + "\n".join(f"## {name}\n\n{to_markdown(table)}" for name, table in tables.items())
    return {
        "md": markdown,
        "csv": to_csv(tables),
        "tex": "\n".join(to_latex(table, f"{title}. {name}") for name, table in tables.items()),
    }
