"""What a run folder holds, for `scene-experts info RUN`."""

from __future__ import annotations

import shlex
from pathlib import Path

from rich.console import Console
from rich.table import Table

from scene_experts.commands import PROG
from scene_experts.core.io import read_json
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import number
from scene_experts.files.export import NAME
from scene_experts.training import run_folder
from scene_experts.training.progress import format_duration


def print_run(run: Path, console: Console) -> None:
    """Print the facts of a run, and the command that comes next. Raises InputError if the run has no
    intact checkpoint."""
    table = Table(box=None, show_header=False)
    for name, value in find_facts(run).items():
        table.add_row(name, value)
    console.print(table)
    console.print(f"next: {propose_next(run)}", markup=False, soft_wrap=True)


def find_facts(run: Path) -> dict[str, str]:
    """Return the facts of a run by name: recipe, capture, iterations, size, scores and files. Raises
    InputError if the run has no intact checkpoint."""
    opened = run_folder.open_run(run)
    config, traits = opened.config, opened.scene.traits
    of_all = "" if opened.step >= config.train.iterations else f" of {config.train.iterations:,}; `train --resume` goes on"
    facts = {
        "run": str(run),
        "recipe": config.train.recipe,
        "capture": str(config.data.path),
        "resolution": config.data.resolution,
        "held out": config.data.split,
        "iterations": f"{opened.step:,}{of_all}, in {format_duration(opened.clock.seconds)}",
        traits.rows: f"{len(opened.scene.table):,}",
        "seed": str(config.train.seed),
        "scores": find_scores(run) or "none: `eval` makes them",
        "begun by": config.command,
        "files": ", ".join(sorted(path.name for path in run.glob(f"{NAME}.*") if path.suffix != ".json")) or "none: `export` writes them",
    }
    return {name: value for name, value in facts.items() if value}


def find_scores(run: Path) -> str:
    """Return the scores of the held-out views; empty if there are none."""
    if not (run / "results.json").is_file():
        return ""
    found = read_json(run / "results.json", "results")
    try:
        psnr, ssim, step = (number(found[name], name, -1e6, 1e9) for name in ("psnr", "ssim", "step"))  # type: ignore[index]
        lpips = found.get("lpips")  # type: ignore[union-attr]
    except (Damaged, LookupError, TypeError):
        return ""
    of_it = "" if lpips is None else f", LPIPS {lpips:.3f}"
    return f"PSNR {psnr:.2f} dB, SSIM {ssim:.3f}{of_it} (held-out views, iteration {step:,.0f})"


def propose_next(run: Path) -> str:
    """Return the command that comes next for a trained run."""
    scored = (run / "results.json").is_file() or run_folder.read_config(run).data.split == "none"
    words = ["export", str(run), "--format", "html"] if scored else ["eval", str(run)]
    return shlex.join([PROG, *words])
