"""Fuzz every reader for a time: `make fuzz SECONDS=600`, or `python -m fuzz.run SECONDS [TARGET ...]` from the folder tests.

Workers read batches of mutated inputs. A worker that dies is restarted behind the input that ended it. Findings are printed with
the name and number from which `python -m fuzz.worker NAME NUMBER 1 FOLDER` makes the same input again.

Each batch adds a line to build/fuzz.jsonl: target, first number, number of inputs, findings. The last lines of a run give the totals
of all runs in this file. The first number of a run is the time in milliseconds, so runs never share inputs.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from fuzz.targets import TARGETS

BATCH = 500
COUNTS = Path(__file__).parents[2] / "build" / "fuzz.jsonl"


def main() -> int:
    seconds, names = float(sys.argv[1]), sys.argv[2:] or list(TARGETS)
    begin, end = time.monotonic(), time.monotonic() + seconds
    first = int(os.environ.get("FUZZ_FIRST", time.time_ns() // 1_000_000))
    place = dict.fromkeys(names, first)
    done: Counter[str] = Counter()
    found: dict[str, list[str]] = {name: [] for name in names}
    while time.monotonic() < end:
        for name in names:
            if time.monotonic() >= end:
                break
            number, findings = place[name], len(found[name])
            with tempfile.TemporaryDirectory() as folder:
                place[name] += run_batch(name, number, Path(folder), done, found[name], end)
            add_count(COUNTS, {"target": name, "first": number, "inputs": place[name] - number, "findings": len(found[name]) - findings})
    print(f"{sum(done.values()):,} inputs in {time.monotonic() - begin:.0f} s")
    for name in names:
        print(f"{name:26} {done[name]:8,} inputs {len(found[name]):5} findings")
    print(describe_totals(read_counts(COUNTS)))
    return int(any(found.values()))


def add_count(path: Path, count: dict[str, Any]) -> None:
    """Append the count of one batch to the file of all runs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a") as file:
        file.write(json.dumps(count) + "\n")


def read_counts(path: Path) -> list[dict[str, Any]]:
    """Return the counts of all runs."""
    return [json.loads(line) for line in path.read_text().splitlines()] if path.is_file() else []


def describe_totals(counts: list[dict[str, Any]]) -> str:
    """Return the totals of all runs as text. An input that several runs have read counts once."""
    spans: dict[str, list[tuple[int, int]]] = {}
    for count in counts:
        spans.setdefault(count["target"], []).append((count["first"], count["first"] + count["inputs"]))
    total = 0
    for found in spans.values():
        end = -1
        for first, last in sorted(found):
            total += max(0, last - max(first, end))
            end = max(end, last)
    findings = sum(count["findings"] for count in counts)
    firsts = [count["first"] for count in counts]
    numbers = f", numbers {min(firsts)} to {max(firsts) + BATCH}" if firsts else ""
    return f"all runs: {total:,} inputs of {len(spans)} targets, {findings} findings{numbers}"


def run_batch(name: str, first: int, folder: Path, done: Counter[str], found: list[str], end: float) -> int:
    """Run a batch in a worker and return how many inputs it has read."""
    command = [sys.executable, "-m", "fuzz.worker", name, str(first), str(BATCH), str(folder)]
    worker = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=Path(__file__).parents[1])
    try:
        out, err = worker.communicate(timeout=max(20.0, min(600.0, end - time.monotonic() + 20)))
    except subprocess.TimeoutExpired:
        worker.kill()
        out, err = worker.communicate()
    lines = [json.loads(line) for line in out.splitlines() if line.startswith("{")]
    for line in lines:
        if "wrong" in line:
            report(found, name, line["number"], line["wrong"])
    if any("done" in line for line in lines):
        done[name] += BATCH
        return BATCH
    current = folder / "current"
    words = current.read_text().split() if current.is_file() else []
    number = int(words[1]) if len(words) == 2 else first  # it may have been stopped while it wrote the file
    done[name] += number - first + 1
    if time.monotonic() < end:  # it was not stopped: it died
        report(found, name, number, f"exit code {worker.returncode} {err[-600:]}")
    return number - first + 1


def report(found: list[str], name: str, number: int, wrong: str) -> None:
    found.append(wrong)
    if len(found) <= 20:
        print(f"--- {name} {number}: {wrong}", flush=True)


if __name__ == "__main__":
    sys.exit(main())
