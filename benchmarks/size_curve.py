"""Quality over bytes: each file is read back and its held-out views are scored against photographs.

    python benchmarks/size_curve.py RUN... [--json FILE] [--figure FILE.svg]

Scenes of anchors become compact files of several --quality; scenes of standard Gaussians become
sog, spz and compressed-ply. Runs trained with --rate are points of their own. Files that --json
already has are not made again. --figure draws what it has (needs matplotlib).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from typing import Any

import scene_experts as se

QUALITIES = (0.03, 0.1, 0.2, 0.4, 0.8)  # dB that training views may lose
DEFAULT = 0.2
STANDARD = ("sog", "spz", "compressed-ply")


def files_of(run: se.Run) -> list[tuple[str, dict[str, float]]]:
    """The formats of a run's files, with their options."""
    if run.scene.traits.needs_bake:
        return [("compact", {"quality": quality}) for quality in QUALITIES]
    return [(name, {}) for name in STANDARD]


def measure(run: se.Run, folder: Path, format: str, options: dict[str, float]) -> dict[str, Any]:
    """Write a file of a run, read it back and score it."""
    began = time.process_time()
    file = run.export(format, folder / "file", **options)  # type: ignore[arg-type]
    wrote = time.process_time() - began
    scores = se.import_run(file, run.capture, folder / "read").evaluate()
    return {
        "bytes": sum(part.stat().st_size for part in ([file] if file.is_file() else file.rglob("*")) if part.suffix != ".json"),
        "psnr": scores.psnr,
        "ssim": scores.ssim,
        "lpips": scores.lpips,
        "export_cpu_seconds": wrote,
    }


LINES = {  # recipe and format: name, colour, marker
    ("one-network", "compact"): ("one-network, compact", "#0b5cad", "o"),
    ("scaffold-gs", "compact"): ("Scaffold-GS, compact", "#d1730a", "s"),
    ("3dgs-mcmc", "sog"): ("3DGS-MCMC, sog", "#777777", "^"),
    ("3dgs-mcmc", "spz"): ("3DGS-MCMC, spz", "#aaaaaa", "v"),
}


def draw(rows: list[dict[str, Any]], place: Path) -> None:
    """Draw PSNR and LPIPS over bytes, a column for each capture. Of runs with --rate only the file of
    the default --quality is shown: they make a line together."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import FixedLocator, NullFormatter, StrMethodFormatter

    captures = list(dict.fromkeys(row["capture"] for row in rows))
    figure, axes = pyplot.subplots(2, len(captures), figsize=(2.6 * len(captures) + 0.6, 4.6), squeeze=False, sharex="col")
    named = {}
    for column, capture in enumerate(captures):
        for (recipe, format), (name, colour, marker) in LINES.items():
            mine = [row for row in rows if (row["capture"], row["recipe"], row["format"]) == (capture, recipe, format)]
            rated = [row for row in mine if row["rate"] and row["quality"] == DEFAULT]
            plain = [row for row in mine if not row["rate"]]
            for line, label, style in ((plain, name, "--" if rated else "-"), (rated, name + ", --rate", "-")):
                line = sorted(line, key=lambda row: row["bytes"])
                for axis, score in zip(axes[:, column], ("psnr", "lpips")) if line else ():
                    x, y = [row["bytes"] / 1e6 for row in line], [row[score] for row in line]
                    named[label] = axis.plot(x, y, style, color=colour, marker=marker, markersize=4, linewidth=1.5)[0]
        axes[0, column].set_title("South Building" if capture == "south" else capture, fontsize=10)
        for axis in axes[:, column]:
            axis.set_xscale("log")
            axis.grid(color="#e6e6e6", linewidth=0.6)
            axis.xaxis.set_major_locator(FixedLocator([0.25, 0.5, 1, 2, 3, 4, 8, 16]))
            axis.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.tick_params(labelsize=8)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("PSNR, dB", fontsize=9)
    axes[1, 0].set_ylabel("LPIPS, less is better", fontsize=9)
    figure.supxlabel("MB of the file, networks included", fontsize=9, y=0.1)
    figure.legend(named.values(), named.keys(), loc="lower center", ncols=3, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0.09, 1, 1))
    figure.savefig(place, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figure", type=Path)
    args = parser.parse_args()
    rows = json.loads(args.json.read_text()) if args.json and args.json.is_file() else []
    for place in args.runs:
        run = se.open_run(place)
        rate = getattr(run.recipe, "rate", 0.0)
        about = {"run": place.name, "capture": run.capture.name, "recipe": run.recipe.recipe, "seed": run.recipe.seed, "rate": rate}
        for format, options in files_of(run):
            same = {**about, "format": format, **options}
            if any(same.items() <= row.items() for row in rows):
                continue
            with tempfile.TemporaryDirectory() as folder:
                found = measure(run, Path(folder), format, options)
            label = f"{run.recipe.recipe}, {format}" + (f", --rate {rate:g}" if rate else "")
            rows.append({**same, "label": label, "training_seconds": run.seconds, **found})
            print(f"{about['capture']} {label} {options or ''}: {found['bytes']:,} bytes, {found['psnr']:.3f} dB, LPIPS {found['lpips']}")
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1) + "\n")
    if args.figure:
        draw(rows, args.figure)


if __name__ == "__main__":
    main()
