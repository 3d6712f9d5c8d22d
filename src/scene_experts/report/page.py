"""Build a web page from run folders: scores, held-out views with a slider, training curves,
experts, configuration and command."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from html import escape
from importlib.resources import files
from pathlib import Path
from string import Template
from typing import Any

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_bytes
from scene_experts.core.plain import to_json
from scene_experts.core.reading.budget import RUN
from scene_experts.core.reading.source import guarding, inside
from scene_experts.evaluate.alignment import ALIGNED_SHORT
from scene_experts.evaluate.photographs import WORST
from scene_experts.evaluate.results import describe_failed, find_difference, find_failed, find_outdated
from scene_experts.evaluate.tables import ResultTable, explain, make_table
from scene_experts.report import chart
from scene_experts.report.chart import Line
from scene_experts.report.photographs import list_photographs
from scene_experts.report.source import ShownRun, group_by_capture, read_run, tell_apart
from scene_experts.report.views import encode_picture, show_captures

NAME = "report.html"
LONGEST_STRIP = 1600  # px; larger strips are scaled down
MOST_TURNED = 3  # runs in a table whose rows are the scores
LOSSES = {
    "l1": "l1: mean absolute difference of pixels",
    "dssim": "dssim: 1 - SSIM",
    "volume": "volume: size of the Gaussians, kept small",
    "opacity": "opacity: mean negative opacity, which the hinge pushes towards 0 so that more Gaussians are drawn",
    "load": "load: unequal use of the experts",
}
"""What the terms of the loss are, for the page."""


def write(runs: Sequence[Path], out: Path | None = None) -> Path:
    """Write the page of evaluated runs and return its path, by default RUN/report.html for a single
    run.

    Raises InputError if a run is not evaluated, and for several runs without `out`.
    """
    if not runs:
        raise InputError("expected at least one run folder, found none; name the folders that `scene-experts train --out` wrote")
    if out is None and len(runs) > 1:
        raise InputError("expected --out FILE.html for several runs, found none; give one")
    if out is not None and out.is_dir():
        out = out / NAME
    if out is not None and out.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"expected --out as a folder or a file ending in .html, found {out}; make the folder first, or name a file")
    with guarding(runs[0] if len(runs) == 1 else "one of the runs", RUN):  # the files of a run may hold anything
        sources = tell_apart([read_run(run) for run in runs])
        page = build_page(sources).encode()
    path = out or runs[0] / NAME
    write_bytes(path, page)
    return path


def build_page(sources: Sequence[ShownRun]) -> str:
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
        *(f"<p class='warn'>{escape(line)}.</p>" for line in find_failures(sources)),
        *explain_views(sources),
        views,
        "<h2>Scores</h2>",
        format_table(replace(scores, best=frozenset()) if other else scores),
        "<h2>Training</h2>",
        explain_curves(sources),
        f"<div class='charts'>{draw_curves(sources)}</div>",
        show_experts(sources),
        "<h2>Scores by view</h2>",
        *((f"<h3>{escape(capture)}</h3>" if len(groups) > 1 else "") + format_scores(group) for capture, group in groups.items()),
        "<h2>Photographs</h2>",
        *(
            (f"<p><b>{escape(s.name)}</b></p>" if len(sources) > 1 else "") + list_photographs(s, WORST // min(len(sources), 4))
            for s in sources
        ),
        "<h2>Command and configuration</h2>",
        *(show_command(s) for s in sources),
        f"<script>const pictures = {json.dumps(pictures)};</script>",
    ]
    template = Template(files("scene_experts.report").joinpath("page.html").read_text())
    return template.safe_substitute(title=escape(title), body="\n".join(parts))


def explain_views(sources: Sequence[ShownRun]) -> tuple[str, str]:
    """Return the heading of the shown views, and what they are."""
    trained = [s.name for s in sources if s.views != "test"]
    held = not trained
    which = "Photographs that the training did not use"
    if trained and len(trained) < len(sources):
        which += f", but those of {', '.join(map(escape, trained))}, which held none out and saw these: other views look worse"
    elif trained:
        which = "Photographs that were trained on, because none was held out: other views look worse"
    how = "the best view and the worst view first. Move the pointer over a picture, or drag the slider."
    return f"<h2>{'Held-out' if held else 'Training'} views</h2>", f"<p class='soft'>{which}; {how}</p>"


def describe_scores(r: dict[str, Any]) -> str:
    """Name the scored views, the resolution and the iterations of the training."""
    whole = f" of {r['iterations']:,}" if r.get("step") and (r.get("iterations") or 0) > r["step"] else ""
    steps = f", {r['step']:,}{whole} iterations" if r.get("step") else ""
    views = {"test": "held-out", "train": "training"}.get(str(r.get("views")), r.get("views"))
    aligned = f", {ALIGNED_SHORT}" if r.get("alignment") else ""
    return f"{r.get('view_count')} {views} views ({r.get('split')}), {r.get('resolution')}{steps}{aligned}"


def find_failures(sources: Sequence[ShownRun]) -> list[str]:
    """Return a sentence for each run about the views that fail."""
    found = [(s.name, describe_failed(s.per_view)) for s in sources]
    return [text if len(sources) == 1 else f"{name}: {text}" for name, text in found if text]


def format_table(found: ResultTable) -> str:
    """Return a table as HTML with its best cells marked, its notes below, and what its columns are.

    The scores of a few runs are rows, which fit on a phone, each beside its explanation. Those of
    many runs are columns.
    """
    notes = "".join(f"<p class='soft'>{escape(note)}</p>" for note in found.notes)
    terms = dict(explain(found.titles))
    mark = lambda i, j: " class=best" if (i, j) in found.best else ""  # noqa: E731
    if len(found.rows) <= MOST_TURNED:
        head = "".join(f"<th scope=col>{escape(row[0])}</th>" for row in found.rows)
        rows = "".join(
            f"<tr><th scope=row>{escape(title)}</th>"
            + "".join(f"<td{mark(i, j)}>{escape(row[j])}</td>" for i, row in enumerate(found.rows))
            + f"<td class=about>{escape(terms.get(title, ''))}</td></tr>"
            for j, title in enumerate(found.titles[1:], 1)
        )
        head = f"<tr><th scope=col>score</th>{head}<th scope=col class=about>what it is</th></tr>"
        return f"<table class=scores style='--runs:{len(found.rows)}'>{head}{rows}</table>{notes}"
    head = "".join(f"<th scope=col>{escape(t)}</th>" for t in found.titles)
    rows = "".join(
        f"<tr>{''.join(f'<td{mark(i, j)}>{escape(cell)}</td>' for j, cell in enumerate(row))}</tr>" for i, row in enumerate(found.rows)
    )
    items = "".join(f"<dt>{escape(title)}</dt><dd>{escape(text)}</dd>" for title, text in terms.items())
    return f"<div class='wide' tabindex=0><table><tr>{head}</tr>{rows}</table></div>{notes}<dl class=terms>{items}</dl>"


def explain_curves(sources: Sequence[ShownRun]) -> str:
    """Return what the curves of the training show, as HTML."""
    terms = sorted({t for s in sources for m in s.metrics for t in m.get("terms", {})})
    named = "; ".join(LOSSES.get(term, f"{term}: a term of the recipe") for term in terms)
    text = "Training PSNR is measured on the photographs that are trained on, so it is higher than that of the held-out views."
    return f"<p class='soft'>{text}{f' Losses: {escape(named)}.' if named else ''}</p>"


def draw_curves(sources: Sequence[ShownRun]) -> str:
    """Draw charts over the iterations: PSNR, losses, anchors, Gaussians, active share, wall
    time."""

    def series(key: str, factor: float = 1.0, smooth: bool = True, anchored: bool = False) -> list[Line]:
        out = []
        for s in sources:
            if anchored and s.results.get("activation_ratio") is None:  # explicit Gaussians have no active share
                continue
            points = [(m["step"], m[key] * factor) for m in s.metrics if isinstance(m.get(key), (int, float)) and "psnr" in m]
            out.append(Line(s.name, chart.smooth(points) if smooth else points))
        return out

    parts = [chart.lines("training PSNR", series("psnr"), "dB")]
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


def show_experts(sources: Sequence[ShownRun]) -> str:
    """Show the experts' shares at the end, one view by the anchors of each expert, and curves of
    shares and gate entropy.

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


def show_strips(s: ShownRun) -> str:
    """Show one held-out view by the anchors of each expert: colour open, other attributes folded.
    Empty without such pictures."""
    folder = s.pictures / "experts"
    found = {a: inside(folder, f"{a}.png") for a in s.results.get("experts") or {}}
    present = sorted((a for a, path in found.items() if path.is_file()), key=lambda a: a != "color")
    if not present:
        return ""
    images = [
        f"<div class='wide' tabindex=0><img class='strip' alt='{escape(a)} experts' src='{encode_picture(found[a], LONGEST_STRIP)}'></div>"
        for a in present
    ]
    folded = "".join(f"<details><summary>{escape(a)}</summary>{image}</details>" for a, image in zip(present[1:], images[1:]))
    k = s.results["experts"][present[0]].get("k")
    how = f"the anchors routed to each expert, rendered alone; Top-{k} puts every anchor in {k} picture{'' if k == 1 else 's'}"
    if k is None:
        how = "the anchors where each expert's gate is the largest, rendered alone; the mixture is dense"
    view = escape(next(iter(s.per_view), "a held-out view"))
    return f"<p><b>{escape(s.name)}</b>, {view}: <span class='soft'>{escape(how)}.</span></p>{images[0]}{folded}"


def format_scores(sources: Sequence[ShownRun]) -> str:
    """Return the table of scores by view as HTML."""
    rows = []
    failed = {name for s in sources for name in find_failed(s.per_view)}
    for name in dict.fromkeys(name for s in sources for name in s.per_view):
        cells = []
        for s in sources:
            facts = s.per_view.get(name, {})
            cells += [
                f"<td>{facts[k]:.{d}f}</td>" if facts.get(k) is not None else "<td>-</td>"
                for k, d in (("psnr", 2), ("ssim", 3), ("lpips", 3))
            ]
        rows.append(f"<tr{' class=fails' if name in failed else ''}><td>{escape(name)}</td>{''.join(cells)}</tr>")
    head = "".join(f"<th>PSNR {escape(s.name)}</th><th>SSIM</th><th>LPIPS</th>" for s in sources)
    return f"<div class='wide' tabindex=0><table><tr><th>view</th>{head}</tr>{''.join(rows)}</table></div>"


def show_command(s: ShownRun) -> str:
    """Show the command that repeats a run, and its configuration."""
    line = s.config.command or "This run was trained by another program."
    config = json.dumps(to_json(s.config), indent=1)
    return (
        f"<p><b>{escape(s.name)}</b></p><pre tabindex=0>{escape(line)}</pre>"
        f"<details><summary>configuration and versions</summary><pre>{escape(config)}</pre></details>"
    )
