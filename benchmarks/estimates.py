"""Every time left that a command tells, and how long it was in truth.

    python benchmarks/estimates.py scene-experts make PHOTOS --minutes 3

The command's lines are shown as they come. A time "left in all" ends with the command, any other
with its work: the last line that tells of it. The table has both, and how many are within 30 %.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from dataclasses import dataclass

LEFT = re.compile(r"(?P<left>\d+(:\d\d)+) left(?P<whole> in all)?")
STEP = re.compile(r"^ *[\d,]+/[\d,]+  ")
WITHIN = 0.3
SHORT = 10.0  # seconds of truth below which a time is not judged: lines come every 15 s


@dataclass(frozen=True)
class Line:
    """A line of a command."""

    at: float  # seconds since it began
    text: str

    @property
    def work(self) -> str:
        """What it tells the progress of."""
        return "training" if STEP.match(self.text) else self.text.partition(":")[0].partition(" (")[0]


def parse_seconds(text: str) -> float:
    """Seconds of m:ss or h:mm:ss."""
    return float(sum(int(part) * 60**i for i, part in enumerate(reversed(text.split(":")))))


def run(command: list[str]) -> tuple[list[Line], float]:
    """Run a command; returns its lines and the seconds that it took."""
    began, lines = time.monotonic(), []
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert process.stdout is not None
    for text in process.stdout:
        lines.append(Line(time.monotonic() - began, text.rstrip()))
        print(f"{lines[-1].at:7.1f}  {lines[-1].text}", flush=True)
    if code := process.wait():
        raise SystemExit(f"{command[0]} ended with exit code {code}")
    return lines, time.monotonic() - began


def judge(lines: list[Line], end: float) -> list[tuple[Line, float, float]]:
    """Return each line that tells a time left, with that time and the true one in seconds."""
    ends = {line.work: line.at for line in lines}
    found = []
    for line in lines:
        if match := LEFT.search(line.text):
            true = (end if match["whole"] else ends[line.work]) - line.at
            if true >= SHORT:
                found.append((line, parse_seconds(match["left"]), true))
    return found


def main() -> None:
    if not sys.argv[1:] or sys.argv[1].startswith("-"):
        raise SystemExit(__doc__)
    found = judge(*run(sys.argv[1:]))
    print(f"\n{'at, s':>7} {'told, s':>8} {'true, s':>8} {'ratio':>6}  work")
    for line, told, true in found:
        print(f"{line.at:7.0f} {told:8.0f} {true:8.0f} {told / true:6.2f}  {line.work}")
    good = sum(abs(told / true - 1) <= WITHIN for _, told, true in found)
    print(f"{good} of {len(found)} within {100 * WITHIN:.0f} %")


if __name__ == "__main__":
    main()
