"""What a run folder or the file of a scene holds, for `scene-experts info`."""

from __future__ import annotations

import shlex
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table
from torch import Tensor

from scene_experts.commands import PROG
from scene_experts.core.io import read_json
from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.numbers import number
from scene_experts.evaluate.results import results_file
from scene_experts.files.export import NAME
from scene_experts.files.lone import open_scene
from scene_experts.files.registry import DESCRIPTIONS, recognise
from scene_experts.files.scene_folder import world_of
from scene_experts.training import run_folder
from scene_experts.training.progress import format_duration


def print_run(run: Path, console: Console) -> None:
    """Print the facts of a run, and the command that comes next. Raises InputError if the run has no
    intact checkpoint."""
    _print(find_facts(run), propose_next(run), console)


def print_file(path: Path, console: Console) -> None:
    """Print the facts of a scene without a run, and how to see it. Raises InputError for what cannot be
    read."""
    _print(find_file_facts(path), shlex.join([PROG, "view", str(path)]), console)


def _print(facts: dict[str, str], proposal: str, console: Console) -> None:
    table = Table(box=None, show_header=False)
    table.add_column(no_wrap=True)
    table.add_column(overflow="fold")
    for name, value in facts.items():
        table.add_row(name, value)
    console.print(table)
    console.print(f"next: {proposal}", markup=False, soft_wrap=True)


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


def find_file_facts(path: Path) -> dict[str, str]:
    """Return the facts of a file, a folder of SOG or a result folder by name: format, bytes, what it is
    made of, its extent, and what it says about its training. Raises InputError for what cannot be
    read."""
    opened = open_scene(path)
    assert opened.lone is not None
    source, scene, note = opened.lone.source, opened.scene, opened.lone.note
    sides = _extent(scene.positions.detach().cpu()) / world_of(opened).scale
    trained = opened.step or note.get("step", 0)
    facts = {
        "file": str(source),
        "format": _describe_format(source),
        scene.traits.rows: f"{len(scene.table):,}",
        "extent": " x ".join(f"{side:.3g}" for side in sides.tolist())
        + f" in the file's unit (1 % of the {scene.traits.rows} left out on each side)",
        "recipe": note.get("recipe", ""),
        "iterations": f"{trained:,}" if trained else "",
    }
    return {name: value for name, value in facts.items() if value}


def _describe_format(source: Path) -> str:
    """The name of a file's format, or that it is a result folder, and the bytes with all that belongs to
    it."""
    name, format = ("result folder", None) if source.is_dir() else recognise(source)
    beside = source if source.is_dir() else source.parent if source.name in DESCRIPTIONS else None
    if beside is not None:
        size = sum(file.stat().st_size for file in beside.rglob("*") if file.is_file())
    else:
        size = format.size(source) if format and format.size else source.stat().st_size
    return f"{name}, {size:,} bytes"


def _extent(positions: Tensor) -> Tensor:
    """The sides [3] of a box along the axes, without the lowest and highest 1 % of each."""
    rows = positions.sort(dim=0).values
    left_out = len(rows) // 100
    return rows[len(rows) - 1 - left_out] - rows[left_out] if len(rows) else torch.zeros(3)


def find_scores(run: Path) -> str:
    """Return the scores of the held-out views, or of the training views of a run that holds none out;
    empty if there are none."""
    file = results_file(run)
    if not file.is_file():
        return ""
    found = read_json(file, "results")
    try:
        psnr, ssim, step = (number(found[name], name, -1e6, 1e9) for name in ("psnr", "ssim", "step"))  # type: ignore[index]
        lpips, views = found.get("lpips"), found.get("views")  # type: ignore[union-attr]
    except (Damaged, LookupError, TypeError):
        return ""
    of_it = "" if lpips is None else f", LPIPS {lpips:.3f}"
    return f"PSNR {psnr:.2f} dB, SSIM {ssim:.3f}{of_it} ({'training' if views == 'train' else 'held-out'} views, iteration {step:,.0f})"


def propose_next(run: Path) -> str:
    """Return the command that comes next for a trained run."""
    scored = results_file(run).is_file() or run_folder.read_config(run).data.split == "none"
    words = ["export", str(run), "--format", "html"] if scored else ["eval", str(run)]
    return shlex.join([PROG, *words])
