"""Scores after a short training: every recipe at every size gets the same CPU seconds, and all are scored
at one size.

    OMP_NUM_THREADS=1 python benchmarks/short.py CAPTURE... [--seconds 180] [--arms one-network@800 ...] [--json FILE]

An arm is a recipe and the longest side of the photographs that it sees. Its iterations are those that
take the seconds, loading and a dense start counted: a tenth of a training tells how long the whole
will take, and it begins anew where that is not what it has. The other tenth is not counted. Each
training is a process of its own; every 8th photograph is held out.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import scene_experts as se

ARMS = [f"{recipe}@{side}" for recipe in ("scaffold-gs", "scene-experts", "one-network") for side in (400, 600, 800)]
FIRST = 1000  # iterations of the first attempt
LEAST = 300
CLOSE = 0.06  # share by which the seconds may be missed, as far as a tenth tells
ATTEMPTS = 3
ONE = "import json, sys; sys.path.insert(0, sys.argv[1]); import short; print(json.dumps(short.run(*json.loads(sys.argv[2]))))"


def train(capture: se.Capture, recipe: str, seconds: float, out: Path) -> dict[str, Any]:
    """Train for so many CPU seconds of this process from now on."""
    from scene_experts.training.course import find_course

    iterations = FIRST
    for attempt in range(ATTEMPTS):
        began, start, other = time.process_time(), 0.0, 0
        made = se.recipe(recipe, iterations=iterations)
        course = find_course(made.scaled(), capture.train_cameras, cuda=False)
        trainer = se.Trainer(made, capture, out, overwrite=True, preview_every=0, save_every=iterations)
        for event in trainer:
            if isinstance(event, se.Started):
                start = time.process_time()
            elif isinstance(event, se.Stepped) and attempt < ATTEMPTS - 1 and not other and event.step >= iterations // 10:
                spent, loading = time.process_time() - start, start - began
                training = spent * course.spent(iterations) / course.spent(event.step)
                other = iterations
                if abs((loading + training) / seconds - 1) > CLOSE:
                    other = max(LEAST, round(iterations * (seconds - loading) / training))
                if other != iterations:
                    trainer.stop("another length fits the time")
        if other in (0, iterations):
            break
        iterations = other
    return {"iterations": iterations, "cpu_seconds": time.process_time() - began}


def score(out: Path, side: int) -> dict[str, Any]:
    """Score the held-out photographs at this size."""
    from scene_experts.evaluate.score import evaluate
    from scene_experts.render import as_trained, choose
    from scene_experts.training import run_folder

    opened = run_folder.open_run(out)
    data = replace(opened.config.data, resolution=f"longest:{side}")
    opened = replace(opened, config=replace(opened.config, data=data), capture="")
    capture = run_folder.capture_of(opened)
    with tempfile.TemporaryDirectory() as folder:
        found = evaluate(opened.scene, capture, as_trained(choose("auto", "cpu"), False), Path(folder), step=opened.step)
    return {name: found[name] for name in ("psnr", "ssim", "lpips", "detail")} | {"rows": len(opened.scene.table)}


def run(capture: str, recipe: str, side: int, seconds: float, scored_at: int) -> dict[str, Any]:
    """One arm on one capture."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        began = time.process_time()
        loaded = se.load_capture(capture, resolution=f"longest:{side}")
        loading = time.process_time() - began
        found = train(loaded, recipe, seconds - loading, out)
        found["cpu_seconds"] += loading
        found["bytes"] = sum(file.stat().st_size for file in (out / "point_cloud").rglob("*") if file.is_file())
        return found | score(out, scored_at)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("captures", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=180.0)
    parser.add_argument("--scored-at", type=int, default=800)
    parser.add_argument("--arms", nargs="+", default=ARMS)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    rows = json.loads(args.json.read_text()) if args.json and args.json.is_file() else []
    for capture in args.captures:
        for arm in args.arms:
            recipe, _, side = arm.partition("@")
            about = {"capture": capture.name, "recipe": recipe, "side": int(side), "seconds": args.seconds}
            if any(about.items() <= row.items() for row in rows):
                continue
            words = json.dumps([str(capture), recipe, int(side), args.seconds, args.scored_at])
            done = subprocess.run(
                [sys.executable, "-c", ONE, str(Path(__file__).parent), words], check=True, stdout=subprocess.PIPE, text=True
            )
            rows.append(about | json.loads(done.stdout.splitlines()[-1]))
            print(rows[-1], flush=True)
            if args.json:
                args.json.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
