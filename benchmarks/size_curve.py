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


def draw(rows: list[dict[str, Any]], place: Path) -> None:
    """Draw PSNR and LPIPS over bytes, a column for each capture."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot
    from matplotlib.ticker import LogLocator, StrMethodFormatter

    captures = sorted({row["capture"] for row in rows})
    figure, axes = pyplot.subplots(2, len(captures), figsize=(4 * len(captures), 6), squeeze=False, sharex="col")
    for column, capture in enumerate(captures):
        mine = [row for row in rows if row["capture"] == capture]
        for label in sorted({row["label"] for row in mine}):
            line = sorted((row for row in mine if row["label"] == label), key=lambda row: row["bytes"])
            for axis, score in zip(axes[:, column], ("psnr", "lpips")):
                axis.plot([row["bytes"] / 1e6 for row in line], [row[score] for row in line], "o-", markersize=3, linewidth=1, label=label)
        axes[0, column].set(title=capture, xscale="log", ylabel="PSNR, dB" if column == 0 else "")
        axes[1, column].xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
        axes[1, column].xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes[1, column].xaxis.set_minor_formatter("")
        axes[1, column].set(xlabel="MB, all told", ylabel="LPIPS (VGG)" if column == 0 else "")
    axes[0, 0].legend(fontsize=7)
    figure.tight_layout()
    figure.savefig(place)


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
