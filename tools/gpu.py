"""Do everything that a GPU is needed for: `make gpu DATA=.gpu/capture OUT=FOLDER`, repeated until it prints "all done".

    python tools/gpu.py --data CAPTURE --out FOLDER --seconds 500 [--trainings FILE]
    python tools/gpu.py --data CAPTURE --out FOLDER --plan            # print the stages and run nothing

It runs with the Python of the machine as it is: nothing is installed and nothing is fetched. What takes long to build comes from the folder
`--parts`, made beforehand by `tools/gpu_parts.py`. A stage is one command with a limit. Its output is shown as it runs. A stage that
succeeded is not run again if the command is repeated with the same --out, even if that folder was emptied between; one that failed is.
FOLDER gets at most 8 files: log.txt, stages.json, train.json, and scores.json and scores.zip of the trainings side by side. Checkpoints and
pictures stay in build/gpu.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.metadata
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tarfile
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
WORK = ROOT / "build" / "gpu"
PARTS = ROOT / ".gpu"
LARGEST = 16 << 20  # bytes of a file of results
TIMED = ("scaffold-gs", "scene-experts", "moe-gs")  # trainings against plain gsplat
PHASES = ("scaffold-gs@3000", "scene-experts@12000", "moe-gs@3000", "moe-gs@12000", "sags@3000")  # dense experts before 10,000
TESTS = (
    *("tests/unit/render/test_gsplat.py", "tests/unit/render/test_project_cuda.py", "tests/unit/render/test_triton_project.py"),
    *("tests/unit/scene/anchors/test_triton_decode.py", "tests/unit/scene/anchors/test_triton_kernels.py"),
    *("tests/unit/scene/anchors/test_triton_routing.py", "tests/unit/geometry/test_triton_rotation.py"),
    *("tests/unit/scene/anchors/test_frozen.py", "tests/unit/training/test_triton_loss.py", "tests/unit/training/test_triton_adam.py"),
    *("tests/unit/training/test_triton_peer.py", "tests/unit/native/test_triton.py", "tests/unit/native/test_triton_probe.py"),
    *("tests/unit/training/test_direct.py", "tests/unit/scene/test_triton_gaussians.py", "tests/unit/strategy/test_observe.py"),
    *("tests/unit/scene/graph/test_fused.py", "tests/unit/scene/graph/test_triton_kernels.py"),
    *("tests/unit/core/test_transfer.py", "tests/unit/evaluate/test_metrics.py"),
)
"""The tests of what runs on CUDA. Named, because others import packages that a GPU machine need not have."""
WORKERS = 12


@dataclass(frozen=True)
class Stage:
    """One command."""

    name: str
    title: str
    command: tuple[str, ...]
    limit: float
    """Seconds after which it is ended."""
    least: float = 15.0
    """Seconds that must remain to begin it."""
    timed: bool = False
    """Whether the command takes --seconds and ends by itself."""


@dataclass(frozen=True)
class Sizes:
    """Words of the commands that decide how long they take."""

    kernels: tuple[str, ...] = ()
    decode: tuple[str, ...] = ()
    tests: tuple[str, ...] = ()
    steps: tuple[str, ...] = ()
    train: tuple[str, ...] = ("--iterations", "3000")
    eval: tuple[str, ...] = ()
    together: tuple[str, ...] = ()


SMALL = ("--resolution", "longest:160")
TINY = Sizes(
    kernels=("--count", "60", "--width", "32", "--height", "24", "--rounds", "1", "--copy", "1"),
    decode=("--anchors", "20", "--rounds", "1", "--copy", "1", "--forms", "native"),  # torch splits rows by counts that must be right
    tests=("--collect-only",),
    steps=(*SMALL, "--rounds", "1"),
    train=(*SMALL, "--iterations", "2", "--count", "200"),  # the recipe draws as many Gaussians as a pretended device says: none
    eval=(*SMALL, "--iterations", "2"),
    together=("--save-every", "1"),
)


def list_stages(data: Path, work: Path, trainings: Path | None, sizes: Sizes | None = None) -> list[Stage]:
    """All stages in order: what shows that the kernels are right, then what is short, then trainings. sizes: None for a real run."""
    python, of, capture = sys.executable, sizes or Sizes(), ("--data", str(data))
    several = ("-n", str(min(WORKERS, len(os.sched_getaffinity(0))))) if importlib.util.find_spec("xdist") and sizes is None else ()
    tests = ("-m", "pytest", "-q", "-m", "not slow", "-p", "no:cacheprovider", "--tb=short", *several, *of.tests, *TESTS)
    train = ("benchmarks/train_cuda.py", *capture, "--out", str(work / "train"), *of.train, "--recipes", *TIMED)
    together = ("benchmarks/train_together.py", *capture, "--out", str(work / "together"), "--trainings", str(trainings), *of.together)
    stages = [
        Stage("machine", "Machine", ("-m", "scene_experts", "doctor"), 60),
        Stage("tests", "Tests of what runs on CUDA", tests, 150),
        Stage("kernels", "Rasteriser, loss and Adam", ("benchmarks/kernels_cuda.py", *of.kernels), 60),
        Stage("decode", "Decode of anchors", ("benchmarks/decode_cuda.py", *of.decode), 60),
        Stage("steps", "Steps, kernel by kernel", ("benchmarks/profile_cuda.py", *capture, *of.steps, *PHASES), 150),
        Stage("eval", "Scoring of the held-out views", ("benchmarks/eval_cuda.py", *capture, "--out", str(work / "eval"), *of.eval), 90),
        Stage("train", "Trainings, each with plain gsplat of its size", train, 300, least=60, timed=True),
        *([Stage("together", "Trainings side by side", together, 540, least=180, timed=True)] if trainings else []),
    ]
    return [Stage(s.name, s.title, (python, *s.command), s.limit, s.least, s.timed) for s in stages]


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--out", type=Path, required=True, help="folder of the results; it also names what is continued")
    parser.add_argument("--seconds", type=float, default=500.0, help="after which this call ends")
    parser.add_argument("--trainings", type=Path, help="trainings to run side by side, one a line (benchmarks/train_together.py)")
    parser.add_argument("--parts", type=Path, default=PARTS, help="folder of tools/gpu_parts.py")
    parser.add_argument("--stages", nargs="+", metavar="NAME", help="run only these")
    parser.add_argument("--plan", action="store_true", help="print the stages and run nothing")
    parser.add_argument("--tiny", action="store_true", help="smallest sizes, to rehearse the commands")
    return parser


def main(argv: list[str] | None = None) -> int:
    args = make_parser().parse_args(argv)
    deadline = time.monotonic() + args.seconds
    data, out, trainings = (path and path.resolve() for path in (args.data, args.out, args.trainings))  # the stages run in ROOT
    work = WORK / re.sub(r"\W+", "-", str(out)).strip("-")
    stages = list_stages(data, work, trainings, TINY if args.tiny else None)
    names = [stage.name for stage in stages]
    if unknown := sorted(set(args.stages or ()) - set(names)):
        raise SystemExit(f"expected stages of {', '.join(names)}, found {', '.join(unknown)}; see --plan")
    stages = [stage for stage in stages if not args.stages or stage.name in args.stages]
    if args.plan:
        print("\n".join(f"{stage.name:10}{stage.limit:5.0f} s  {' '.join(stage.command)}" for stage in stages))
        return 0
    environment = prepare(args.parts)
    work.mkdir(parents=True, exist_ok=True)
    left = run_stages(stages, work, out, deadline, lambda stage, seconds, show: run_command(stage, seconds, show, environment))
    print(f"to do: {', '.join(left)}; run the same command again" if left else "all done")
    return 0


def prepare(parts: Path) -> dict[str, str]:
    """Unpack the parts, and return the environment of the stages. Without parts, what is installed is used."""
    if differences := find_differences(parts):
        print(f"the parts in {parts} are for {differences}: make them anew with a Python like this machine's (tools/gpu_parts.py)")
    path = [ROOT / "src", ROOT / "benchmarks", *([parts / "site"] if (parts / "site").is_dir() else [])]
    environment = os.environ | {"SCENE_EXPERTS_GPU": "1", "PYTHONUNBUFFERED": "1", "PYTHONDONTWRITEBYTECODE": "1"}
    environment["PYTHONPATH"] = os.pathsep.join([*map(str, path), *filter(None, [os.environ.get("PYTHONPATH")])])
    environment.setdefault("OMP_NUM_THREADS", "4")
    packed = parts / "triton.tar.xz"
    if packed.is_file() and "TRITON_CACHE_DIR" not in environment:
        cache = WORK / f"triton-{hashlib.sha256(packed.read_bytes()).hexdigest()[:12]}"
        if not cache.is_dir():
            unpack_cache(packed, cache)
        environment["TRITON_CACHE_DIR"] = str(cache)
    native = ROOT / "src" / "scene_experts" / "_native"
    if (parts / "native").is_dir() and not native.exists() and importlib.util.find_spec("scene_experts") is None:  # not installed here
        shutil.copytree(parts / "native", native)
    return environment


def find_differences(parts: Path) -> str:
    """Where this machine differs from the one that the parts were made for, in words. Empty: nowhere, or no parts."""
    if not (parts / "parts.json").is_file():
        return ""
    made, here = json.loads((parts / "parts.json").read_text()), list_versions()
    return ", ".join(f"{name} {made[name]}, not {here[name]}" for name in here if made.get(name) != here[name])


def list_versions() -> dict[str, str]:
    """What the parts depend on."""
    found = {"Python": f"{sys.version_info.major}.{sys.version_info.minor}"}
    for name in ("torch", "triton"):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "missing"
    return found


def unpack_cache(archive: Path, cache: Path) -> None:
    """Unpack Triton's cache. Its index files name their neighbours by whole paths, which change."""
    with tarfile.open(archive) as tar:
        tar.extractall(cache, filter="data")
    for index in cache.glob("*/__grp__*.json"):
        names = json.loads(index.read_text())["child_paths"]
        index.write_text(json.dumps({"child_paths": {name: str(index.parent / name) for name in names}}))


Show = Callable[[str], None]
Runner = Callable[[Stage, float, Show], int]
"""Runs a stage for at most so many seconds and hands its output on as it comes. Returns the exit code."""


def run_stages(stages: list[Stage], work: Path, out: Path, deadline: float, run: Runner) -> list[str]:
    """Run what is left until the deadline (of time.monotonic). Returns the names of the stages that have not succeeded."""
    path = work / "stages.json"
    state: dict[str, dict[str, float | str]] = json.loads(path.read_text()) if path.is_file() else {}
    for stage in stages:
        seconds = min(stage.limit, deadline - time.monotonic())
        if state.get(stage.name, {}).get("end") == "done" or seconds < stage.least:
            continue
        last, began = "", time.monotonic()
        with (work / "log.txt").open("a") as log:

            def show(line: str, log=log) -> None:
                nonlocal last
                last = line.strip() or last
                log.write(line)
                print(line, end="", flush=True)

            show(f"\n== {stage.title} (at most {seconds:.0f} s): {' '.join(stage.command)}\n")
            code = run(stage, seconds, show)
            unfinished = last.startswith("to do")
            end = "too long" if code == 124 else f"exit {code}" if code else "unfinished" if unfinished else "done"
            show(f"== {stage.name}: {end}, {time.monotonic() - began:.1f} s\n")
        state[stage.name] = {"end": end, "seconds": round(time.monotonic() - began, 1)}
        path.write_text(json.dumps(state, indent=1))
        collect(work, out)
    return [stage.name for stage in stages if state.get(stage.name, {}).get("end") != "done"]


def run_command(stage: Stage, seconds: float, show: Show, environment: dict[str, str] | None = None) -> int:
    """Run a command in a group of its own, which is ended as a whole after `seconds`: then the exit code is 124."""
    command = [*stage.command, "--seconds", str(round(max(1, seconds - 10)))] if stage.timed else list(stage.command)
    process = subprocess.Popen(
        command,
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        errors="replace",
        start_new_session=True,
    )
    late = threading.Event()

    def end() -> None:
        late.set()
        os.killpg(process.pid, signal.SIGKILL)

    timer = threading.Timer(seconds, end)
    timer.start()
    assert process.stdout is not None
    try:
        for line in process.stdout:
            show(line)
        code = process.wait()
    finally:
        timer.cancel()
        if process.poll() is None:  # this process was interrupted
            end()
    return 124 if late.is_set() else code


def collect(work: Path, out: Path) -> None:
    """Copy the results so far to the folder that travels. A file that is too large stays."""
    out.mkdir(parents=True, exist_ok=True)
    found = {name: work / name for name in ("log.txt", "stages.json")}
    found |= {"train.json": work / "train" / "results.json"}
    found |= {name: work / "together" / name for name in ("scores.json", "scores.zip")}
    for name, path in found.items():
        if path.is_file() and path.stat().st_size < LARGEST:
            shutil.copyfile(path, out / name)
        elif path.is_file():
            print(f"{path} has {path.stat().st_size >> 20} MiB, 16 are too many: it stays on this machine")


if __name__ == "__main__":
    raise SystemExit(main())
