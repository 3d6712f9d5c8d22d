"""Run every group of measurements within a budget and report the figures as a table and as JSON."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table

from scene_experts.bench import parts, raster, step
from scene_experts.bench.machine import Machine, describe, measure_clock, measure_copy, measure_multiply_adds
from scene_experts.bench.measure import Figure, Missing, Result
from scene_experts.core.errors import InputError
from scene_experts.core.io import check_writable, write_json
from scene_experts.core.version import __version__
from scene_experts.native import library as native


@dataclass(frozen=True)
class Size:
    """Size of the measured work."""

    gaussians: int
    width: int
    height: int
    anchors: int  # of the whole step; half of them are visible and decoded


# A scene draws about five Gaussians per visible anchor.
FULL, MEDIUM, SMALL = Size(100_000, 800, 544, 40_000), Size(20_000, 400, 272, 8_000), Size(2_000, 160, 112, 800)


def choose_size(seconds: float) -> Size:
    """The size that the documentation uses if the budget allows it, else a smaller one."""
    return FULL if seconds >= 30 else MEDIUM if seconds >= 8 else SMALL


def measure(seconds: float, threads: int, say: Callable[[str], None] = lambda _: None) -> tuple[Machine, Size, list[Result]]:
    """Measure the rates of the machine and every figure. Takes about `seconds` on an idle
    machine."""
    machine, size = describe(threads), choose_size(seconds)
    say("rates of the machine")
    share = seconds / 60
    machine = replace(
        machine,
        clock_hz=measure_clock(machine.level, share),
        multiply_adds=measure_multiply_adds(machine.level, 1, share),
        copied=measure_copy(share),
    )
    results: list[Result] = []
    with step.use_threads(1):
        for what, group in _list_groups(machine, size, share):
            say(what)
            results += group()
    return machine, size, results


def _list_groups(machine: Machine, size: Size, share: float) -> Iterator[tuple[str, Callable[[], list[Result]]]]:
    """Name and function of each group. Together, with slow peers and the synthesis of scenes, they
    take 60 times `share` seconds."""
    scene = raster.make_picture(size.gaussians, size.width, size.height)
    yield "rasteriser", lambda: raster.measure(scene, machine, 7 * share)
    yield "decode", lambda: parts.measure_decode(size.anchors // 2, machine, 6 * share)
    yield "loss", lambda: parts.measure_loss(size.width, size.height, machine, 2 * share)
    yield "whole step", lambda: step.measure(size.anchors, size.width, size.height, machine, 8 * share)
    yield "threads", lambda: step.measure_scaling(scene, machine, 8 * share)


def run(seconds: float, threads: int | None, json: Path | None, console: Console) -> int:
    """Measure, print, and write `json` if it is given.

    Raises InputError for an invalid budget or number of threads, and RunError where `json` cannot
    be written, before it measures.
    """
    if not 0 < seconds < float("inf"):
        raise InputError(f"expected --seconds above 0, found {seconds:g}; use --seconds 60")
    most = 4 * native.count_cores()  # thousands of threads exhaust the process
    if threads is not None and not 1 <= threads <= most:
        raise InputError(f"expected --threads from 1 to {most}, found {threads}; omit it to use torch's setting")
    if json is not None:
        if json.is_dir():
            raise InputError(f"expected --json as a file, found the folder {json}; add a name")
        check_writable(json, "--json")
    began = time.perf_counter()
    with console.status("measuring") as status:
        machine, size, results = measure(seconds, threads or torch.get_num_threads(), lambda what: status.update(f"measuring {what}"))
    took = time.perf_counter() - began
    print_table(machine, size, results, console)
    reason = native.explain_missing()
    if reason is not None:
        console.print(f"missing: {reason}", markup=False, soft_wrap=True)
    console.print(f"{took:.0f} s; times are minima of interleaved runs, processor time for one thread", soft_wrap=True)
    if json is not None:
        write_json(json, convert_to_json(machine, size, results, took))
        console.print(f"wrote {json}", markup=False, soft_wrap=True)
    return 0


def print_table(machine: Machine, size: Size, results: list[Result], console: Console) -> None:
    """Print the machine in a few lines and one table with a section per group."""
    rates = [f"clock {machine.clock_hz / 1e9:.2f} GHz"] if machine.clock_hz else []
    rates += [f"{2 * machine.multiply_adds / 1e9:.0f} GFLOP/s"] if machine.multiply_adds else []
    rates += [f"copies {machine.copied / 1e9:.1f} GB/s"] if machine.copied else []
    level = (
        f"instruction set in use: {machine.level} (installed: {', '.join(machine.levels)})" if machine.level else "no compiled CPU library"
    )
    console.print(f"{machine.processor}, {machine.cores} cores usable, torch {machine.torch}", markup=False, soft_wrap=True)
    console.print(f"{level}; one thread: {', '.join(rates)}", markup=False, soft_wrap=True)
    work = f"{size.gaussians:,} Gaussians of a synthetic garden, {size.width}x{size.height} px; {size.anchors:,} anchors, half visible"
    console.print(f"measured on {work}", soft_wrap=True)
    table = Table(box=None, pad_edge=False, show_edge=False)
    table.add_column("", no_wrap=True)
    table.add_column("measured", justify="right", no_wrap=True)
    table.add_column("speed-up over a peer; note")
    group = ""
    for result in results:
        if result.group != group:
            table.add_section()
            group = result.group
            table.add_row(f"[bold]{group}[/bold]")
        if isinstance(result, Missing):
            table.add_row(f"  {result.name}", "-", result.why)
        else:
            beside = [f"{_format(result.ratio)} x {result.peer}"] if result.ratio is not None else []
            notes = "; ".join([*beside, *([result.note] if result.note else [])])
            table.add_row(f"  {result.name}", f"{_format(result.value)} {result.unit}", notes)
    console.print(table)


def _format(value: float) -> str:
    return f"{value:.3g}" if abs(value) < 100 else f"{value:,.0f}"


def convert_to_json(machine: Machine, size: Size, results: list[Result], took: float) -> dict[str, Any]:
    """All figures as plain JSON, each value with its unit and its peer."""
    figures = [asdict(r) for r in results if isinstance(r, Figure)]
    missing = [asdict(r) for r in results if isinstance(r, Missing)]
    head = {"version": __version__, "seconds": took, "machine": asdict(machine), "size": asdict(size)}
    return {**head, "figures": figures, "missing": missing}
