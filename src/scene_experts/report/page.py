"""Build a web page from run folders: scores, held-out views with a slider, training curves, experts, configuration and command."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.io import read_json, write_bytes
from scene_experts.core.plain import to_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.plain import read_json_lines
from scene_experts.core.reading.source import guarding, inside
from scene_experts.evaluate.pictures import read_picture
from scene_experts.evaluate.results import find_difference, find_outdated, load_results
from scene_experts.evaluate.tables import ResultTable, distinguish_runs, make_table
from scene_experts.report import chart
from scene_experts.report.chart import Line
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig

NAME = "report.html"
MOST_VIEWS = 8  # of a capture; pictures are most of a page's bytes
LONGEST, LONGEST_STRIP = 960, 1600  # px; larger pictures and strips are scaled down
QUALITY = 88  # of the JPEGs


@dataclass(frozen=True)
class Source:
    """What the page shows of one run. `metrics`: lines of metrics.jsonl; `per_view`: scores by the name of a view."""

    name: str
    path: Path
    config: RunConfig
    results: dict[str, Any]
    per_view: dict[str, dict[str, Any]]
    metrics: list[dict[str, Any]]


def write(runs: Sequence[Path], out: Path | None = None) -> Path:
    """Write the page of evaluated runs and return its path, by default RUN/report.html for a single run.

    Raises InputError if a run is not evaluated, and for several runs without `out`.
    """
    if not runs:
        raise InputError("expected at least one run folder, found none; name the folders that `scene-experts train --out` wrote")
    if out is None and len(runs) > 1:
        raise InputError("expected --out FILE.html for several runs, found none; give one")
    with guarding(runs[0] if len(runs) == 1 else "one of the runs", RUN):  # the files of a run may hold anything
        sources = tell_apart([read_run(run) for run in runs])
        page = build_page(sources).encode()
    path = out or runs[0] / NAME
    write_bytes(path, page)
    return path


def read_run(run: Path) -> Source:
    """Read a run folder. Raises InputError if it is not evaluated or its scores by view are invalid."""
    config, results = run_folder.read_config(run), load_results(run)
    path = run / "per_view.json"
    per_view = read_json(path, "scores by view") if path.is_file() else {}
    if not isinstance(per_view, dict) or not all(isinstance(v, dict) and isinstance(v.get("file"), str) for v in per_view.values()):
        raise InputError(f"expected scores by view in {path}, found something else; run `scene-experts eval {run}` again")
    with guarding(path, RUN, "file of scores by view"):
        for facts in per_view.values():
            inside(run / "test" / "gt", facts["file"])
    return Source(config.train.recipe, run, config, results, per_view, read_metrics(run / "metrics.jsonl"))


def tell_apart(sources: list[Source]) -> list[Source]:
    """Give runs of the same recipe different names."""
    names = distinguish_runs([s.path for s in sources], [s.name for s in sources])
    return [replace(s, name=name) for s, name in zip(sources, names)]


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """Read the complete lines of a metrics file."""
    return [line for line in read_json_lines(path) if isinstance(line.get("step"), (int, float))] if path.is_file() else []


def build_page(sources: Sequence[Source]) -> str:
    """Return the page as HTML."""
    names, results = [s.name for s in sources], [s.results for s in sources]
    title = f"{', '.join(names)} on {', '.join(dict.fromkeys(str(r.get('capture', '?')) for r in results))}"
    facts = [describe_scores(s.results) for s in sources]
    subtitle = facts[:1] if len(set(facts)) == 1 else [f"{name}: {fact}" for name, fact in zip(names, facts)]
    groups = group_by_capture(sources)
    views, pictures = show_captures(groups)
    scores, other = make_table(names, results), find_difference(names, results)
    parts = [
        f"<h1>{escape(title)}</h1><p class='soft'>{'<br>'.join(map(escape, subtitle))}</p>",
        *(f"<p><b>{escape(line)}.</b></p>" for line in find_outdated(names, [s.path for s in sources], results)),
        f"<p><b>Do not compare these scores:</b> expected {escape(other[0])}.</p>" if other else "",
        format_table(replace(scores, best=frozenset()) if other else scores),
        "<h2>Held-out views</h2><p class='soft'>Move the pointer over a picture, or drag the slider.</p>",
        views,
        "<h2>Training</h2>",
        f"<div class='charts'>{draw_curves(sources)}</div>",
        show_experts(sources),
        "<h2>Scores by view</h2>",
        *((f"<h3>{escape(capture)}</h3>" if len(groups) > 1 else "") + format_scores(group) for capture, group in groups.items()),
        "<h2>Command and configuration</h2>",
        *(show_command(s) for s in sources),
        f"<script>const pictures = {json.dumps(pictures)};</script>",
    ]
    template = Template(files("scene_experts.report").joinpath("page.html").read_text())
    return template.safe_substitute(title=escape(title), body="\n".join(parts))


def describe_scores(r: dict[str, Any]) -> str:
    """Name the scored views, the resolution and the iterations of the training."""
    whole = f" of {r['iterations']:,}" if r.get("step") and (r.get("iterations") or 0) > r["step"] else ""
    steps = f", {r['step']:,}{whole} iterations" if r.get("step") else ""
    return f"{r.get('view_count')} {r.get('views')} views ({r.get('split')}), {r.get('resolution')}{steps}"


def format_table(found: ResultTable) -> str:
    """Return a table as HTML, with its best cells marked and its notes below."""
    head = "".join(f"<th>{escape(t)}</th>" for t in found.titles)
    rows = []
    for i, row in enumerate(found.rows):
        cells = [f"<td{' class=best' if (i, j) in found.best else ''}>{escape(cell)}</td>" for j, cell in enumerate(row)]
        rows.append(f"<tr>{''.join(cells)}</tr>")
    notes = "".join(f"<p class='soft'>{escape(note)}</p>" for note in found.notes)
    return f"<div class='wide'><table><tr>{head}</tr>{''.join(rows)}</table></div>{notes}"


def group_by_capture(sources: Sequence[Source]) -> dict[str, list[Source]]:
    """Group runs by the name of their capture: only these can have views in common."""
    groups: dict[str, list[Source]] = {}
    for s in sources:
        groups.setdefault(str(s.results.get("capture", "?")), []).append(s)
    return groups


def find_common_views(sources: Sequence[Source]) -> list[str]:
    """Return the names of the views that every run was scored on."""
    return [name for name in sources[0].per_view if all(name in s.per_view for s in sources)]


def show_captures(groups: dict[str, list[Source]]) -> tuple[str, dict[str, str]]:
    """Return the held-out views of each capture as HTML, and their pictures as data URLs by key."""
    pictures: dict[str, str] = {}
    parts = []
    for i, (capture, group) in enumerate(groups.items()):
        views, shown = show_views(group, f"{i}.")
        pictures |= shown
        if len(groups) > 1:
            parts.append(f"<h3>{escape(capture)}</h3>")
        why = "no pictures in the run folder" if find_common_views(group) else "no view that all of these runs held out"
        parts.append(f"<div class='views'>{views}</div>" if views else f"<p>{why}</p>")
    return "\n".join(parts), pictures


def show_views(sources: Sequence[Source], prefix: str) -> tuple[str, dict[str, str]]:
    """Return up to MOST_VIEWS views with their sliders as HTML, and their pictures as data URLs by key. Keys start with `prefix`."""
    pictures: dict[str, str] = {}
    blocks = []
    names = find_common_views(sources)
    step = max(1, -(-len(names) // MOST_VIEWS))
    for n, name in enumerate(names[::step]):
        options = [("photograph", sources[0].path / "test" / "gt" / sources[0].per_view[name]["file"])]
        options += [(s.name, s.path / "test" / "renders" / s.per_view[name]["file"]) for s in sources]
        options += [(f"{s.name}, error", s.path / "test" / "errors" / s.per_view[name]["file"]) for s in sources]
        present = [(label, path) for label, path in options if path.is_file()]
        if len(present) < 2:
            continue
        for i, (_, path) in enumerate(present):
            pictures[f"{prefix}{n}.{i}"] = encode_picture(path)
        scores = ", ".join(f"{s.name} {s.per_view[name]['psnr']:.2f} dB" for s in sources if "psnr" in s.per_view[name])
        pick = [
            "".join(
                f"<option value='{prefix}{n}.{i}'{' selected' if i == wanted else ''}>{escape(label)}</option>"
                for i, (label, _) in enumerate(present)
            )
            for wanted in (0, 1)
        ]
        blocks.append(
            f"<div class='view'><div class='pick'><b>{escape(name)}</b><span class='soft'>{escape(scores)}</span>"
            f"<label>left <select>{pick[0]}</select></label><label>right <select>{pick[1]}</select></label></div>"
            f"<div class='stage'><img alt='left'><img class='over' alt='right'><span class='edge'></span></div>"
            f"<input type='range' min='0' max='100' value='50' aria-label='boundary between the two pictures'></div>"
        )
    return "\n".join(blocks), pictures


def encode_picture(path: Path, longest: int = LONGEST) -> str:
    """Return a picture as the data URL of a JPEG of at most `longest` px a side. Raises InputError if it is unreadable."""
    picture = Image.fromarray(read_picture(path))
    picture.thumbnail((longest, longest), Image.Resampling.LANCZOS)
    stream = io.BytesIO()
    picture.save(stream, format="JPEG", quality=QUALITY)
    return f"data:image/jpeg;base64,{base64.b64encode(stream.getvalue()).decode()}"


def draw_curves(sources: Sequence[Source]) -> str:
    """Draw charts over the iterations: PSNR, losses, anchors, Gaussians, active share, wall time."""

    def series(key: str, factor: float = 1.0, smooth: bool = True, anchored: bool = False) -> list[Line]:
        out = []
        for s in sources:
            if anchored and s.results.get("activation_ratio") is None:  # explicit Gaussians have no active share
                continue
            points = [(m["step"], m[key] * factor) for m in s.metrics if isinstance(m.get(key), (int, float)) and "psnr" in m]
            out.append(Line(s.name, chart.smooth(points) if smooth else points))
        return out

    parts = [chart.lines("PSNR of training views", series("psnr"), "dB")]
    terms = sorted({t for s in sources for m in s.metrics for t in m.get("terms", {})})
    for term in terms:
        lines = [
            Line(s.name, chart.smooth([(m["step"], m["terms"][term]) for m in s.metrics if term in m.get("terms", {})])) for s in sources
        ]
        parts.append(chart.lines(f"loss: {term}", lines, "weighted, log", log=True))
    parts += [
        chart.lines("anchors", series("anchors", smooth=False)),
        chart.lines("rendered Gaussians", series("gaussians")),
        chart.lines("active Gaussians", series("active", 100, anchored=True), "%"),
        chart.lines("wall time of the training", series("seconds", 1 / 60, smooth=False), "minutes"),
    ]
    return "".join(parts)


def show_experts(sources: Sequence[Source]) -> str:
    """Show the experts' shares at the end, one view by the anchors of each expert, and curves of shares and gate entropy.

    Empty without experts.
    """
    bars, charts = [], []
    for s in sources:
        for attribute, shares in (s.results.get("experts") or {}).items():
            values = shares.get("share") or shares.get("mean_gate")
            if values:
                bars.append(chart.bars(f"{s.name}: {attribute}", values))
            found = [(m["step"], m.get("scene_routing") or m.get("routing") or {}) for m in s.metrics]
            routed = [(step, shares[attribute]) for step, shares in found if attribute in shares]
            lines = [Line(f"expert {e + 1}", [(x, 100 * v[e]) for x, v in routed]) for e in range(len(routed[0][1]))] if routed else []
            charts.append(chart.lines(f"{s.name}: share of {attribute}", lines, "%"))
        entropy = sorted({a for m in s.metrics for a in m.get("entropy", {})})
        lines = [Line(a, [(m["step"], m["entropy"][a]) for m in s.metrics if a in m.get("entropy", {})]) for a in entropy]
        charts.append(chart.lines(f"{s.name}: gate entropy (1: equal gates)", lines))
    if not bars:
        return ""
    alone = "".join(map(show_strips, sources))
    shown = "Share of each expert in the assignments of all anchors (in the gates while the mixture is dense)"
    note = f"<p class='soft'>{shown}. Equal shares are perfect balance.</p>"
    return f"<h2>Experts</h2>{note}{''.join(bars)}{alone}<div class='charts'>{''.join(charts)}</div>"


def show_strips(s: Source) -> str:
    """Show one held-out view by the anchors of each expert: colour open, other attributes folded. Empty without such pictures."""
    folder = s.path / "test" / "experts"
    found = {a: inside(folder, f"{a}.png") for a in s.results.get("experts") or {}}
    present = sorted((a for a, path in found.items() if path.is_file()), key=lambda a: a != "color")
    if not present:
        return ""
    images = [f"<img class='strip' alt='{escape(a)} experts' src='{encode_picture(found[a], LONGEST_STRIP)}'>" for a in present]
    folded = "".join(f"<details><summary>{escape(a)}</summary>{image}</details>" for a, image in zip(present[1:], images[1:]))
    k = s.results["experts"][present[0]].get("k")
    how = f"the anchors routed to each expert, rendered alone; Top-{k} puts every anchor in {k} picture{'' if k == 1 else 's'}"
    if k is None:
        how = "the anchors where each expert's gate is the largest, rendered alone; the mixture is dense"
    view = escape(next(iter(s.per_view), "a held-out view"))
    return f"<p><b>{escape(s.name)}</b>, {view}: <span class='soft'>{how}.</span></p>{images[0]}{folded}"


def format_scores(sources: Sequence[Source]) -> str:
    """Return the table of scores by view as HTML."""
    rows = []
    for name in sources[0].per_view:
        cells = []
        for s in sources:
            facts = s.per_view.get(name, {})
            cells += [
                f"<td>{facts[k]:.{d}f}</td>" if facts.get(k) is not None else "<td>-</td>"
                for k, d in (("psnr", 2), ("ssim", 3), ("lpips", 3))
            ]
        rows.append(f"<tr><td>{escape(name)}</td>{''.join(cells)}</tr>")
    head = "".join(f"<th>PSNR {escape(s.name)}</th><th>SSIM</th><th>LPIPS</th>" for s in sources)
    return f"<div class='wide'><table><tr><th>view</th>{head}</tr>{''.join(rows)}</table></div>"


def show_command(s: Source) -> str:
    """Show the command that repeats a run, and its configuration."""
    line = s.config.command or "This run was trained by another program."
    config = json.dumps(to_json(s.config), indent=1)
    return (
        f"<p><b>{escape(s.name)}</b></p><pre>{escape(line)}</pre>"
        f"<details><summary>configuration and versions</summary><pre>{escape(config)}</pre></details>"
    )
