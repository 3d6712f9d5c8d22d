"""Runs every group within a budget, and shows the figures as one table and as JSON."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from rich.console import Console
from rich.table import Table

from scene_experts import __version__
from scene_experts.bench import parts, raster, step
from scene_experts.bench.machine import Machine, clock_hz, copied, describe, multiply_adds
from scene_experts.bench.measure import Figure, Missing, Result
from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.native import library as native


@dataclass(frozen=True)
class Size:
    """How large the measured work is."""

    gaussians: int
    width: int
    height: int
    anchors: int  # of the whole step; half of them are visible, and as many are decoded


# Gaussians that a scene of this many anchors draws are about five for each visible one.
FULL, MEDIUM, SMALL = Size(100_000, 800, 544, 40_000), Size(20_000, 400, 272, 8_000), Size(2_000, 160, 112, 800)


def size_for(seconds: float) -> Size:
    """The documented size where the budget allows it, else a smaller one."""
    return FULL if seconds >= 30 else MEDIUM if seconds >= 8 else SMALL


def measure(seconds: float, threads: int, say: Callable[[str], None] = lambda _: None) -> tuple[Machine, Size, list[Result]]:
    """The machine with its rates, the size of the work, and every figure. Takes about `seconds` on an idle machine."""
    machine, size = describe(threads), size_for(seconds)
    say("the machine's rates")
    share = seconds / 60
    machine = replace(
        machine,
        clock_hz=clock_hz(machine.level, share),
        multiply_adds=multiply_adds(machine.level, 1, share),
        copied=copied(share),
    )
    results: list[Result] = []
    with step.torch_threads(1):
        for what, group in _groups(machine, size, share):
            say(what)
            results += group()
    return machine, size, results


def _groups(machine: Machine, size: Size, share: float) -> Iterator[tuple[str, Callable[[], list[Result]]]]:
    """Name and work of each group; the seconds add up to 60 times `share` with the slow peers and the making of scenes."""
    scene = raster.picture(size.gaussians, size.width, size.height)
    yield "rasteriser", lambda: raster.figures(scene, machine, 7 * share)
    yield "decode", lambda: parts.decode(size.anchors // 2, machine, 6 * share)
    yield "loss", lambda: parts.loss(size.width, size.height, machine, 2 * share)
    yield "whole step", lambda: step.figures(size.anchors, size.width, size.height, machine, 8 * share)
    yield "threads", lambda: step.scaling(scene, machine, 8 * share)


def run(seconds: float, threads: int | None, json: Path | None, console: Console) -> int:
    """Measure, print, and write `json` where asked. Raises InputError for a budget or a number of threads that cannot be."""
    if not 0 < seconds < float("inf"):
        raise InputError(f"expected --seconds above 0, found {seconds:g}; use --seconds 60")
    if threads is not None and threads < 1:
        raise InputError(f"expected --threads of at least 1, found {threads}; leave it out to use torch's own setting")
    began = time.perf_counter()
    with console.status("measuring") as status:
        machine, size, results = measure(seconds, threads or torch.get_num_threads(), lambda what: status.update(f"measuring {what}"))
    took = time.perf_counter() - began
    show(machine, size, results, console)
    reason = native.explain_missing()
    if reason is not None:
        console.print(f"missing: {reason}", markup=False, soft_wrap=True)
    console.print(f"{took:.0f} s; times are the least of interleaved runs, of one thread its processor time", soft_wrap=True)
    if json is not None:
        write_json(json, as_json(machine, size, results, took))
        console.print(f"wrote {json}", markup=False, soft_wrap=True)
    return 0


def show(machine: Machine, size: Size, results: list[Result], console: Console) -> None:
    """The machine in a few lines and one table, a section for each group."""
    rates = [f"clock {machine.clock_hz / 1e9:.2f} GHz"] if machine.clock_hz else []
    rates += [f"{2 * machine.multiply_adds / 1e9:.0f} GFLOP/s"] if machine.multiply_adds else []
    rates += [f"copies {machine.copied / 1e9:.1f} GB/s"] if machine.copied else []
    level = (
        f"instruction set in use: {machine.level} (installed: {', '.join(machine.levels)})" if machine.level else "no compiled CPU library"
    )
    console.print(f"{machine.processor}, {machine.cores} cores usable, torch {machine.torch}", markup=False, soft_wrap=True)
    console.print(f"{level}; one thread: {', '.join(rates)}", markup=False, soft_wrap=True)
    work = f"{size.gaussians:,} Gaussians of a made garden, {size.width}x{size.height} px; {size.anchors:,} anchors, half of them visible"
    console.print(f"measured on {work}", soft_wrap=True)
    table = Table(box=None, pad_edge=False, show_edge=False)
    table.add_column("", no_wrap=True)
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("times as fast as its peer; note")
    group = ""
    for result in results:
        if result.group != group:
            table.add_section()
            group = result.group
            table.add_row(f"[bold]{group}[/bold]")
        if isinstance(result, Missing):
            table.add_row(f"  {result.name}", "-", result.why)
        else:
            beside = [f"{_digits(result.ratio)} x {result.peer}"] if result.ratio is not None else []
            notes = "; ".join([*beside, *([result.note] if result.note else [])])
            table.add_row(f"  {result.name}", f"{_digits(result.value)} {result.unit}", notes)
    console.print(table)


def _digits(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"


def as_json(machine: Machine, size: Size, results: list[Result], took: float) -> dict:
    """Everything measured, as plain JSON; unit and peer beside each value."""
    figures = [asdict(r) for r in results if isinstance(r, Figure)]
    missing = [asdict(r) for r in results if isinstance(r, Missing)]
    head = {"version": __version__, "seconds": took, "machine": asdict(machine), "size": asdict(size)}
    return {**head, "figures": figures, "missing": missing}
