"""Measure cost against size (anchors, Gaussians, resolution, views): time and peak memory of each part, as CSV and log-log plots.

    python benchmarks/scale.py [--quick] [--axes anchors gaussians resolution views] [--out docs/figures]

Each point runs in its own process (benchmarks/scale_points.py) on one thread. Times are minima of processor time, so that other work on
the machine changes them little. For each part the script prints the growth from the previous point as an exponent of the size (1 is
linear).
"""

from __future__ import annotations

import argparse
import csv
import io
import json
import math
import os
import subprocess
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from scene_experts.core.io import write_atomic, write_bytes

Row = tuple[int, str, float | None, float | None]  # size, part, seconds, peak MiB above the imports
SIZES: dict[str, tuple[list[int], list[int]]] = {  # all, quick
    "anchors": ([10_000, 30_000, 100_000, 300_000, 1_000_000, 2_000_000], [10_000, 30_000, 100_000]),
    "gaussians": ([10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 10_000_000], [10_000, 30_000, 100_000]),
    "resolution": ([180, 360, 720, 1080, 2160], [180, 360, 720]),
    "views": ([50, 100, 200, 500, 1000, 2000], [50, 100]),
}
LABELS = {
    "anchors": "anchors, half of them visible, 800x544",
    "gaussians": "Gaussians, 800x544",
    "resolution": "pixels (16:9), 100,000 Gaussians",
    "views": "views of 640x424, image cache 64 MiB",
}


def count_pixels(height: int) -> int:
    return height * (height * 16 // 9 // 2 * 2)


def measure_point(axis: str, size: int) -> list[Row]:
    """Measure one point. If it fails (out of memory), print why and return no rows."""
    command = [sys.executable, str(Path(__file__).with_name("scale_points.py")), axis, str(size)]
    done = subprocess.run(command, env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True, check=False)
    if done.returncode:
        print(f"{axis} {size:,}: ended with {done.returncode}: {(done.stderr.strip().splitlines() or ['killed'])[-1]}")
        return []
    x = count_pixels(size) if axis == "resolution" else size
    return [(x, what, seconds, None if peak is None else peak / 2**20) for what, seconds, peak in json.loads(done.stdout.splitlines()[-1])]


def compute_exponent(before: Row, row: Row, column: int) -> float | None:
    """log(cost ratio) / log(size ratio) of two rows of the same part."""
    a, b = before[column], row[column]
    if a is None or b is None or a <= 0 or b <= 0:  # type: ignore[operator]
        return None
    return math.log(b / a) / math.log(row[0] / before[0])  # type: ignore[operator]


def print_rows(axis: str, rows: list[Row]) -> None:
    """Print one line per part and size, with the exponents of time and memory."""
    print(f"\n{LABELS[axis]}\n{'part':42}{'size':>12}{'ms':>12}{'exponent':>10}{'peak MiB':>10}{'exponent':>10}")
    for what in dict.fromkeys(row[1] for row in rows):
        before: Row | None = None
        for row in (r for r in rows if r[1] == what):
            slopes = [None if before is None else compute_exponent(before, row, column) for column in (2, 3)]
            time, memory = ("" if s is None else f"{s:.2f}" for s in slopes)
            took = "" if row[2] is None else f"{1e3 * row[2]:.2f}"
            held = "" if row[3] is None else f"{row[3]:.0f}"
            print(f"{what:42}{row[0]:>12,}{took:>12}{time:>10}{held:>10}{memory:>10}")
            before = row


def write_csv(path: Path, rows: list[Row]) -> None:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["size", "part", "seconds", "peak_mib"])
    writer.writerows((x, what, "" if s is None else f"{s:.6g}", "" if peak is None else f"{peak:.1f}") for x, what, s, peak in rows)
    write_bytes(path, text.getvalue().encode())


def plot(path: Path, axis: str, rows: list[Row]) -> None:
    """Plot time on the left and memory on the right; the grey lines are linear."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.6), layout="constrained")
    colours = {what: f"C{i % 10}" for i, what in enumerate(dict.fromkeys(row[1] for row in rows))}
    for ax, column, unit, factor in ((axes[0], 2, "milliseconds, one thread", 1e3), (axes[1], 3, "peak MiB above imports", 1.0)):
        for i, what in enumerate(colours):
            points = [(row[0], factor * row[column]) for row in rows if row[1] == what and row[column]]  # type: ignore[operator]
            if points:
                style = "--" if i >= 10 or what.endswith("alone") else "-"
                ax.plot(*zip(*points), style, color=colours[what], marker="o", markersize=3, linewidth=1.4, label=what)
        ax.set(xscale="log", yscale="log", xlabel=LABELS[axis], ylabel=unit)
        low, high = ax.get_ylim()
        left, right = (f(row[0] for row in rows) for f in (min, max))
        start = low / right * left
        while start < high:  # lines of slope 1, a factor of 10 apart
            ax.plot([left, right], [start, start * right / left], color="0.88", linewidth=0.8, zorder=0)
            start *= 10
        ax.set_ylim(low, high)
        ax.grid(alpha=0.25, which="major")
    handles = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels())}
    figure.legend(handles.values(), handles.keys(), fontsize=7.5, loc="outside right center", frameon=False)
    write_atomic(path, lambda temporary: figure.savefig(temporary, format="png", dpi=120))
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--axes", nargs="+", choices=list(SIZES), default=list(SIZES))
    parser.add_argument("--quick", action="store_true", help="only small sizes, about a minute")
    parser.add_argument("--most", type=int, help="skip sizes above this")
    parser.add_argument("--out", type=Path, default=Path(__file__).parents[1] / "docs" / "figures")
    args = parser.parse_args()
    for axis in args.axes:
        sizes = SIZES[axis][1 if args.quick else 0]
        rows = [row for size in sizes if not args.most or size <= args.most for row in measure_point(axis, size)]
        if rows:
            print_rows(axis, rows)
            write_csv(args.out / f"scale_{axis}.csv", rows)
            plot(args.out / f"scale_{axis}.png", axis, rows)
    print(f"\nwrote {args.out}")


if __name__ == "__main__":
    main()
