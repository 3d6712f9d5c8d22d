"""Figures 1(b), 3, 6 and 7 of the paper from our records, as PNG."""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.extras import install_line
from scene_experts.core.io import write_bytes
from scene_experts.reproduce.experiments import ROUTINGS, Experiment
from scene_experts.reproduce.statistics import clock_of, mean, on_common_runs, select
from scene_experts.reproduce.store import Record

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # distinct for colour-blind readers

ROUTING_NAMES = {"top1": "Top-1", "top2": "Top-2", "dense": "dense"}


def canvas(columns: int = 1, width: float = 6.4, height: float = 3.8) -> tuple[Any, Any]:
    """Return a figure and its axes [1, columns]; `width` and `height` in inches. Raises InputError
    without matplotlib."""
    try:
        import matplotlib
    except ImportError as error:
        raise InputError(f"expected matplotlib to draw figures, found none; {install_line('plots')}") from error
    matplotlib.use("Agg")
    from matplotlib import pyplot

    return pyplot.subplots(1, columns, figsize=(width * columns**0.8, height), layout="constrained", squeeze=False)


def save(figure: Any, path: Path) -> list[Path]:
    """Write a PNG file of 256 colours, whole or not at all. The same figure gives the same
    bytes."""
    from matplotlib import pyplot

    drawn, small = io.BytesIO(), io.BytesIO()
    figure.savefig(drawn, format="png", dpi=160)
    pyplot.close(figure)
    with Image.open(drawn) as image:
        image.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(small, "PNG", optimize=True)  # a third of the bytes
    out = path.with_suffix(".png")
    write_bytes(out, small.getvalue())
    return [out]


def relative_psnr(experiment: Experiment, records: Sequence[Record], scenes: Sequence[str], path: Path) -> list[Path]:
    """Draw Figure 1(b): PSNR relative to the first row (3DGS) in %, scenes in the order of
    Scaffold-GS's anchor counts."""
    anchors = {s: m.value for s in scenes if (m := mean(select(records, "scaffold-gs", s), "anchors"))}
    (_, first), *others = experiment.rows.items()
    shown = sorted((s for s in scenes if s in anchors and select(records, first, s)), key=lambda s: anchors[s])
    if not shown:
        return []
    figure, axes = canvas(width=max(6.4, 0.9 * len(shown)))
    for i, (name, recipe) in enumerate(others):
        found = []
        for j, s in enumerate(shown):
            both = on_common_runs([r for r in records if r.scene == s], (recipe, first))  # seeds of both
            psnr, base = (mean(select(both, which), "psnr") for which in (recipe, first))
            if psnr and base:
                found.append((j + (i - (len(others) - 1) / 2) * 0.38, 100 * (psnr.value / base.value - 1)))
        axes[0, 0].bar([x for x, _ in found], [height for _, height in found], 0.36, color=COLOURS[i], label=name)
    axes[0, 0].axhline(0, color="black", linewidth=0.8)
    axes[0, 0].set_xticks(range(len(shown)), [f"{s}\n{anchors[s] / 1000:.0f}k" for s in shown])
    axes[0, 0].set(ylabel="PSNR relative to 3DGS, %", xlabel="scene, sorted by the number of Scaffold-GS anchors")
    figure.legend(loc="outside upper center", ncols=len(others))
    return save(figure, path)


def expert_shares(experiment: Experiment, records: Sequence[Record], scene: str, path: Path, attribute: str = "cov") -> list[Path]:
    """Draw Figure 3: each expert's share of the assignments (of the gates while dense) during
    training, one panel per row."""
    found = [(name, select(records, recipe, scene)) for name, recipe in experiment.rows.items()]
    found = [(name, min(rows, key=lambda r: r.seed)) for name, rows in found if rows]
    found = [(name, record) for name, record in found if any(attribute in c.get("scene_routing", {}) for c in record.curves)]
    if not found:
        return []
    figure, axes = canvas(len(found))
    for axis, (name, record) in zip(axes[0], found):
        points = [(c["step"], c["scene_routing"][attribute]) for c in record.curves if attribute in c.get("scene_routing", {})]
        for e in range(len(points[0][1]) if points else 0):
            axis.plot([s for s, _ in points], [100 * v[e] for _, v in points], color=COLOURS[e], label=f"expert {e + 1}")
        dense = record.config.train.scaled().scene.dense_until
        axis.axvline(dense, color="grey", linestyle=":", linewidth=1, label="end of the dense warm-up")
        axis.set(title=f"{name} ({scene})", xlabel="iteration", ylim=(0, 100))
        axis.set_ylabel(f"share of {attribute} assignments (dense: of gates), %")
    handles, labels = axes[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels))
    return save(figure, path)


def cost(experiment: Experiment, records: Sequence[Record], path: Path) -> list[Path]:
    """Draw Figure 6: PSNR against training time, one line per routing, one point per number of
    experts."""
    figure, axes = canvas()
    drawn, records = False, on_common_runs(records, experiment.rows.values())
    clock = clock_of(records)
    for i, routing in enumerate(ROUTINGS):
        points = []
        for num in (2, 3, 4, 5):
            rows = select(records, f"moe-gs-e{num}-{routing}")
            psnr, seconds = mean(rows, "psnr"), mean(rows, clock)
            if psnr and seconds:
                points.append((seconds.value / 60, psnr.value, num))
        if points:
            drawn = True
            axes[0, 0].plot([p[0] for p in points], [p[1] for p in points], "o-", color=COLOURS[i], label=ROUTING_NAMES[routing])
            for x, y, num in points:
                axes[0, 0].annotate(str(num), (x, y), textcoords="offset points", xytext=(5, 4), fontsize=8)
    time = "CPU" if clock == "cpu_seconds" else "wall"
    label = f"training, {time} minutes (mean over {list_scenes(records)})"
    axes[0, 0].set(xlabel=label, ylabel="PSNR, dB (labels: number of experts)")
    if drawn:
        figure.legend(loc="outside upper center", ncols=len(ROUTINGS))
    return save(figure, path) if drawn else discard(figure)


def layers(experiment: Experiment, records: Sequence[Record], path: Path) -> list[Path]:
    """Draw Figure 7: scores of Scaffold-GS against the number of linear layers."""
    columns = [("psnr", "PSNR, dB"), ("ssim", "SSIM"), ("lpips_3dgs", "LPIPS")]
    figure, axes = canvas(len(columns), width=4.2)
    drawn, records = False, on_common_runs(records, experiment.rows.values())
    for axis, (column, title) in zip(axes[0], columns):
        found = [(int(name.split()[0]), mean(select(records, recipe), column)) for name, recipe in experiment.rows.items()]
        points = [(n, m) for n, m in found if m is not None]
        if points:
            drawn = True
            spreads = [m.spread or 0.0 for _, m in points]
            axis.errorbar([n for n, _ in points], [m.value for _, m in points], spreads, fmt="o-", color=COLOURS[0], capsize=3)
        axis.set(xlabel="linear layers", ylabel=title, xticks=[n for n, _ in found])
    figure.suptitle(f"mean over {list_scenes(records)}", fontsize="medium")
    return save(figure, path) if drawn else discard(figure)


def list_scenes(records: Sequence[Record]) -> str:
    """List the scenes of records, for a label."""
    return ", ".join(sorted({r.scene for r in records}))


def discard(figure: Any) -> list[Path]:
    """Close an empty figure."""
    from matplotlib import pyplot

    pyplot.close(figure)
    return []
