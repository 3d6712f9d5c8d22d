"""Train recipes under --max-memory and print the peak memory of each training beside its limit (docs/security.md).

    python tools/memory.py [--recipes moe-gs 3dgs] [--limits 0.5 0.7] [--iterations 120]

Without --recipes, every recipe is trained. Growth is forced: statistics begin at once, and nearly every Gaussian may create others.
A training may also be refused because its start does not fit. Exit code 1 if a peak is more than 5 % above its limit.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FORCED = ("--growth.adjust.start", "1", "--growth.adjust.interval", "20")


def growth_flags(recipe: str) -> list[str]:
    """Return the options that make the table of a recipe grow as fast as it can."""
    if recipe == "3dgs-mcmc":
        return [*FORCED, "--growth.growth", "1.5"]
    flags = [*FORCED, "--growth.grad-threshold", "1e-7"]
    return flags if recipe == "3dgs" else [*flags, "--growth.start-stat", "0", "--growth.success-threshold", "0.1"]


def read_peak(process: int) -> int:
    """Return the peak resident memory of a process in bytes; 0 if it has ended."""
    try:
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)


def train(recipe: str, limit: float, capture: Path, iterations: int, seconds: float) -> tuple[int, int, str]:
    """Train in another process. Return its peak in bytes, the rows at the end, and what is to be said about it."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [sys.executable, "-m", "scene_experts", "train", recipe, "--data", str(capture), "--out", str(out)]
        command += ["--resolution", "factor:4", "--stop-at", str(iterations), "--max-memory", str(limit)]
        command += ["--save-every", "50", "--preview-every", "50", *growth_flags(recipe)]
        errors = Path(folder) / "errors"
        with errors.open("w") as file:
            process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=file, env={**os.environ, "OMP_NUM_THREADS": "1"})
        end, peak = time.monotonic() + seconds, 0
        while process.poll() is None and time.monotonic() < end:
            peak = max(peak, read_peak(process.pid))
            time.sleep(0.02)
        stopped = process.poll() is None
        if stopped:
            process.kill()
            process.wait(timeout=60)
        metrics = out / "metrics.jsonl"
        lines = [json.loads(line) for line in metrics.read_text().splitlines() if line.endswith("}")] if metrics.is_file() else []
        rows = next((line["anchors"] for line in reversed(lines) if "anchors" in line), 0)
        refused = "refused" if process.returncode == 2 and "--max-memory" in errors.read_text() else ""
        failed = f"exit code {process.returncode}: {errors.read_text()[-300:]}" if process.returncode and not stopped else ""
        return peak, rows, refused or ("stopped after the time" if stopped else failed)


def main() -> int:
    from scene_experts.training.recipes import RECIPES

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--recipes", nargs="*", default=list(RECIPES), help="recipes (default: all)")
    parser.add_argument("--limits", nargs="*", type=float, default=[0.5, 0.7], help="limits in GiB (default: 0.5 0.7)")
    parser.add_argument("--capture", type=Path, default=ROOT / "demo" / "buddha")
    parser.add_argument("--iterations", type=int, default=120)
    parser.add_argument("--seconds", type=float, default=120, help="time of one training (default: 120)")
    args = parser.parse_args()
    worst = 0.0
    for recipe in args.recipes:
        for limit in args.limits:
            peak, rows, note = train(recipe, limit, args.capture, args.iterations, args.seconds)
            share = peak / 2**30 / limit
            worst = worst if note == "refused" else max(worst, share)
            print(f"{recipe:22} limit {limit:.2f} GiB  peak {peak / 2**30:.3f} GiB  {share:.3f}  {rows:8,} rows  {note}", flush=True)
    print(f"largest share of a limit that was accepted: {worst:.3f}")
    return int(worst > 1.05)


if __name__ == "__main__":
    sys.exit(main())
