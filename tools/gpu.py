"""Do everything that a GPU is needed for, in slices: `make gpu DATA=CAPTURE`, again and again until it prints "all done".

    python tools/gpu.py --data CAPTURE --out runs/gpu --seconds 500
    python tools/gpu.py --data CAPTURE --plan             # print the commands and run nothing
    python tools/gpu.py --data CAPTURE --dry              # run them at tiny sizes on tensors that pretend to be on CUDA (`make pretend`)

Each call continues where the last one stopped and ends within `--seconds`. A stage is one command. Its output is kept in
OUT/STAGE.txt, and a stage whose command succeeded is not run again. Commands that train work in slices themselves. At the end the tables
are written to the section between the markers of docs/performance.md. The machine needs no network: gsplat and Triton are installed from
the folder `--wheels` if they are missing. A dry run needs no GPU. It shows that the commands work, measures nothing, and writes its
tables to OUT/report.md only. Give it a capture of few points.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
REPORT = ROOT / "docs" / "performance.md"
BEGIN, END = "<!-- make gpu: begin -->", "<!-- make gpu: end -->"
SPARE = 20.0  # seconds of a slice for what is not a stage
LEAST = 60.0  # seconds that must remain to begin a stage
RECIPES = ("scaffold-gs", "scaffold-gs-wide", "3dgs", "moe-gs")  # the peer has as many Gaussians as the last one
THREADS = (1, 2, 4, 8, 16)


@dataclass(frozen=True)
class Sizes:
    """Words of the commands that decide how long they take."""

    speed: tuple[str, ...] = ()
    decode: tuple[str, ...] = ()
    bench: tuple[str, ...] = ()
    tests: tuple[str, ...] = ()
    train: tuple[str, ...] = ("--iterations", "30000")
    least_anchors: int = 500_000


TINY = Sizes(
    speed=("--count", "60", "--width", "32", "--height", "24", "--rounds", "1", "--copy", "1"),
    decode=("--anchors", "20", "--rounds", "1", "--copy", "1"),
    bench=("--seconds", "1"),
    tests=("--collect-only", "-p", "no:cacheprovider"),
    train=("--iterations", "2", "--resolution", "longest:16"),
    least_anchors=60,
)


@dataclass(frozen=True)
class Stage:
    """One command. `again`: it works in slices, and is done once its output ends with "all done"."""

    name: str
    title: str
    command: tuple[str, ...]
    again: bool = False
    shown: bool = True
    """Whether its output belongs into the report."""
    pretends: bool = False
    """Whether a dry run gives it tensors that pretend to be on CUDA."""


def list_stages(data: Path, out: Path, cores: int, sizes: Sizes | None = None) -> list[Stage]:
    """All stages in order: what shows that the kernels are right, then what is short, then trainings. sizes: None for a real run."""
    python, of = sys.executable, sizes or Sizes()
    pytest, package = (python, "-m", "pytest", "-q", *of.tests), (python, "-m", "scene_experts")
    train = (python, "benchmarks/train_cuda.py", "--data", str(data), *of.train)
    large = (*train, "--recipes", "scaffold-gs", "moe-gs", "--out", str(out / "large"), "--least-anchors", str(of.least_anchors))
    decode = (python, "benchmarks/decode_cuda.py", *of.decode)
    threads = [n for n in THREADS if n <= cores]
    return [
        Stage("machine", "Machine", (*package, "doctor")),
        Stage("tests", "Tests that need a GPU", (*pytest, "-m", "gpu", "tests"), shown=False),
        Stage("kernels", "Triton kernels on the GPU", (*pytest, *KERNEL_TESTS), shown=False),
        Stage("speed", "Rasteriser, loss and Adam", (python, "benchmarks/kernels_cuda.py", *of.speed), pretends=True),
        Stage("decode", "Decode of anchors", decode, pretends=True),
        Stage("decode-tf32x3", "Decode of anchors, tensor cores", (*decode, "--precision", "tf32x3"), pretends=True),
        *(Stage(f"cpu-{n}", f"CPU, {n} threads", (*package, "bench", "--threads", str(n), *of.bench)) for n in threads),
        Stage("train", "Trainings", (*train, "--recipes", *RECIPES, "--out", str(out / "train")), again=True, pretends=True),
        Stage("large", f"At {of.least_anchors:,} anchors or more", large, again=True, pretends=True),
    ]


KERNEL_TESTS = (
    "tests/unit/scene/anchors/test_triton_decode.py",
    "tests/unit/scene/graph/test_fused.py",
    "tests/unit/training/test_triton_loss.py",
    "tests/unit/training/test_triton_adam.py",
    "tests/unit/render/test_project_cuda.py",
)


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--out", type=Path, default=ROOT / "runs" / "gpu", help="folder of the results, kept between slices")
    parser.add_argument("--seconds", type=float, default=500.0, help="length of this slice")
    parser.add_argument("--wheels", type=Path, help="folder of wheels to install gsplat and triton from")
    parser.add_argument("--plan", action="store_true", help="print the commands and run nothing")
    parser.add_argument("--dry", action="store_true", help="run the commands at tiny sizes without a GPU")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = make_parser().parse_args(argv)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    stages = list_stages(args.data, args.out, 1 if args.dry else cores, TINY if args.dry else None)
    if args.plan:
        print("\n".join(f"{stage.name:14} {' '.join(stage.command)}" for stage in stages))
        return 0
    os.environ["SCENE_EXPERTS_GPU"] = "1"  # tests see the card
    args.out.mkdir(parents=True, exist_ok=True)
    if args.wheels is not None and (missing := [n for n in ("gsplat", "triton") if importlib.util.find_spec(n) is None]):
        subprocess.run([sys.executable, "-m", "pip", "install", "-q", "--no-index", "--find-links", str(args.wheels), *missing], check=True)
    run = partial(run_pretending, folder=args.out) if args.dry else run_command
    left = run_stages(stages, args.out, time.monotonic() + args.seconds - SPARE, run)
    if left:
        print(f"to do: {', '.join(left)}; run the same command again")
        return 0
    write_report(stages, args.out, None if args.dry else REPORT)
    print("all done")
    return 0


Runner = Callable[[Stage, float], tuple[int, str]]
"""Runs a stage for at most so many seconds; returns its exit code and output."""


def run_stages(stages: list[Stage], out: Path, deadline: float, run: Runner) -> list[str]:
    """Run what is left until the deadline (of time.monotonic). Returns the names of the stages that are not done.

    A stage that fails is tried once more in the next slice, and then counts as done, so that one failure does not stop the others.
    """
    path = out / "stages.json"
    state: dict[str, dict[str, int]] = json.loads(path.read_text()) if path.is_file() else {}
    for stage in stages:
        mine = state.setdefault(stage.name, {"done": 0, "failed": 0})
        while not mine["done"] and deadline - time.monotonic() > LEAST:
            print(f"{stage.title}: {' '.join(stage.command)}", flush=True)
            code, text = run(stage, deadline - time.monotonic())
            (out / f"{stage.name}.txt").write_text(text)
            ended = not stage.again or text.rstrip().endswith("all done")
            if code == 0:
                mine["done"] = int(ended)
            else:
                mine["failed"] += 1
                mine["done"] = int(mine["failed"] > 1)
            path.write_text(json.dumps(state, indent=1))
            if code != 0 or not ended:
                break
    return [stage.name for stage in stages if not state.get(stage.name, {}).get("done")]


def run_command(stage: Stage, seconds: float, environment: dict[str, str] | None = None) -> tuple[int, str]:
    command = [*stage.command, "--seconds", str(round(seconds - 10))] if stage.again else list(stage.command)
    streams: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    try:
        done = subprocess.run(command, cwd=ROOT, env=environment, timeout=seconds, **streams)
    except subprocess.TimeoutExpired as late:
        return 124, late.stdout.decode() if isinstance(late.stdout, bytes) else late.stdout or ""
    return done.returncode, done.stdout


def run_pretending(stage: Stage, seconds: float, folder: Path) -> tuple[int, str]:
    """Run a stage without a GPU. Raises SystemExit if tensors cannot pretend here. folder: of the guard that is built for it."""
    if not stage.pretends:
        return run_command(stage, seconds)
    if str(ROOT / "tests") not in sys.path:
        sys.path.insert(0, str(ROOT / "tests"))
    start = importlib.import_module("support.pretend.start")
    if (reason := start.explain_missing()) is not None:
        raise SystemExit(f"a dry run is not possible: {reason}")
    python, *words = stage.command
    pretending = replace(stage, command=(python, "-m", "support.pretend.script", *words))
    environment = start.make_environment(folder)
    environment["PYTHONPATH"] = os.pathsep.join([str(ROOT / "benchmarks"), environment["PYTHONPATH"]])
    return run_command(pretending, seconds, environment)


def format_report(stages: list[Stage], out: Path) -> str:
    """The tables as Markdown: for each stage its command and its last output, and which stages failed."""
    state = json.loads((out / "stages.json").read_text())
    parts = []
    for stage in stages:
        path, failed = out / f"{stage.name}.txt", state[stage.name]["failed"] > 1
        text = path.read_text().strip() if path.is_file() else ""
        if failed:
            text = "\n".join(text.splitlines()[-15:])
        elif not stage.shown:
            text = "\n".join(text.splitlines()[-1:])
        words = " ".join("python" if word == sys.executable else word for word in stage.command)
        parts.append(f"### {stage.title}{' (FAILED)' if failed else ''}\n\n`{words}`\n\n```\n{text}\n```")
    return "\n\n".join(parts)


def write_report(stages: list[Stage], out: Path, path: Path | None) -> None:
    """Write OUT/report.md, and replace what is between the markers of `path`, if it has them."""
    text, report = path.read_text() if path else "", f"{BEGIN}\n\n{format_report(stages, out)}\n\n{END}"
    if path and BEGIN in text and END in text:
        before, _, rest = text.partition(BEGIN)
        path.write_text(before + report + rest.partition(END)[2])
    (out / "report.md").write_text(report + "\n")


if __name__ == "__main__":
    raise SystemExit(main())
