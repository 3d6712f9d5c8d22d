"""Every reader gets 60 mutated inputs: only InputError, within 5 s and 1 GiB, and no number that is not finite.

`make fuzz SECONDS=600` reads many more. Inputs that were found to break a reader are in REGRESSIONS.
"""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.run import add_count, describe_totals, read_counts
from fuzz.targets import STRUCTURED, TARGETS

REGRESSIONS: dict[str, list[int]] = json.loads((Path(__file__).parent / "regressions.json").read_text())


def read_inputs(name, first, count, folder):
    command = [sys.executable, "-m", "fuzz.worker", name, str(first), str(count), str(folder)]
    ran = subprocess.run(command, capture_output=True, text=True, cwd=Path(__file__).parents[1], timeout=600)
    assert ran.returncode == 0, f"{(folder / 'current').read_text()}: exit code {ran.returncode} {ran.stderr[-2000:]}"
    return [line for line in map(json.loads, ran.stdout.splitlines()) if "wrong" in line]


@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_mutated_inputs(part, tmp_path):
    """Several readers share a process, which loads torch once."""
    assert not read_inputs(",".join(list(TARGETS)[part::4]), STRUCTURED, 60, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in TARGETS if REGRESSIONS.get(name)])
def test_inputs_that_broke_a_reader(name, tmp_path):
    for number in REGRESSIONS[name]:
        assert not read_inputs(name, number, 1, tmp_path)


def test_totals_of_several_runs(tmp_path):
    path = tmp_path / "build" / "fuzz.jsonl"
    for target, first in (("ply", 100), ("ply", 700), ("ply", 400), ("spz", 100), ("spz", 100)):  # 400 overlaps 100 and 700
        add_count(path, {"target": target, "first": first, "inputs": 500, "findings": int(first == 400)})
    assert describe_totals(read_counts(path)).startswith("all runs: 1,600 inputs of 2 targets, 1 findings")
    assert describe_totals([]) == "all runs: 0 inputs of 0 targets, 0 findings"
