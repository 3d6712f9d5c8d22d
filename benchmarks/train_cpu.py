"""CPU time of whole trainings, interleaved: each recipe trains --slice iterations in turn, in one process, up to --iterations.

    OMP_NUM_THREADS=1 python benchmarks/train_cpu.py CAPTURES/fox CAPTURES/fern --recipes scaffold-gs scene-experts --iterations 7000

A recipe may have flags: "moe-gs --scene.decoder.router margin". What else the machine does meets
all recipes alike. The trainings share one random generator, so their scenes are not those of runs.
The table has the CPU time of the iterations (without loading and saving), its ratio to the first
recipe, the 10 % and 90 % quantiles of that ratio over the slices, and what is drawn at the end.
--out gets the CPU seconds of each slice as it ends; a stopped script starts again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch

from scene_experts.data.capture import Capture, load
from scene_experts.data.settings import Data
from scene_experts.render import choose
from scene_experts.reproduce.variants import read_line
from scene_experts.training.config import RunConfig
from scene_experts.training.events import Event, Stepped
from scene_experts.training.job import Job
from scene_experts.training.loop import train
from scene_experts.training.state import Training


@dataclass
class Runner:
    """A training that goes on slice by slice."""

    recipe: str
    events: Iterator[Event]
    training: list[Training]
    seconds: list[float] = field(default_factory=list)  # CPU time of each slice
    anchors: int = 0
    gaussians: int = 0  # drawn, mean of the last slice's views that were measured

    def advance(self, until: int) -> None:
        """Train up to iteration `until`."""
        drawn = []
        before = self.training[0].clock.cpu_seconds or 0.0 if self.training else 0.0
        for event in self.events:
            if isinstance(event, Stepped):
                drawn.append(event.gaussians)
                self.anchors = event.anchors
                if event.step >= until:
                    break
        self.gaussians = round(sum(drawn) / max(len(drawn), 1))
        self.seconds.append((self.training[0].clock.cpu_seconds or 0.0) - before)


def start(recipe: str, folder: Path, capture: Capture, args: argparse.Namespace) -> Runner:
    """Begin the training of a recipe; nothing is computed yet."""
    cfg = replace(read_line(recipe), iterations=args.iterations)
    begun: list[Training] = []
    run = Job(RunConfig(cfg, Data(folder)), begin=begun.append)
    return Runner(recipe, train(cfg, run, capture, choose("auto", "cpu")), begun)


def format_table(rows: dict[str, list[Runner]]) -> str:
    """Return the table as Markdown, a row for each capture and recipe."""
    lines = ["| capture | recipe | CPU s | ratio | 10 - 90 % of slices | anchors | Gaussians drawn |", "|---|---|---:|---:|---|---:|---:|"]
    for capture, runners in rows.items():
        base = torch.tensor(runners[0].seconds)
        for runner in runners:
            own = torch.tensor(runner.seconds)
            low, high = torch.quantile(own / base, torch.tensor([0.1, 0.9])).tolist()
            ratio = f"{own.sum() / base.sum():.2f} | {low:.2f} - {high:.2f}"
            lines.append(f"| {capture} | {runner.recipe} | {own.sum():.0f} | {ratio} | {runner.anchors:,} | {runner.gaussians:,} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description="Compare the CPU time of whole trainings, interleaved.")
    parser.add_argument("captures", type=Path, nargs="+")
    parser.add_argument("--recipes", nargs="+", default=["scaffold-gs", "moe-gs", "scene-experts"])
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--slice", type=int, default=100, help="iterations in turn; a multiple of 10")
    parser.add_argument("--out", type=Path, help="file for the CPU seconds of each slice, JSON")
    args = parser.parse_args()
    rows: dict[str, list[Runner]] = {}
    for folder in args.captures:
        capture = load(Data(folder))
        runners = rows[folder.name] = [start(recipe, folder, capture, args) for recipe in args.recipes]
        for until in [*range(args.slice, args.iterations, args.slice), args.iterations]:
            for runner in runners:
                runner.advance(until)
            if args.out:
                args.out.write_text(json.dumps({name: {r.recipe: r.seconds for r in made} for name, made in rows.items()}))
        capture.images.close()
        print(format_table({folder.name: runners}), flush=True)


if __name__ == "__main__":
    main()
