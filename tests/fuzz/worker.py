"""Runs mutated inputs of one or several targets: `python -m fuzz.worker TARGET,TARGET SEED COUNT OUT`, from the folder tests.

Each input is written to OUT/current before it is read, so that the input that ends the process is known. A line of JSON on stdout
says what each finding was; a last line for each target counts its inputs.
"""

from __future__ import annotations

import json
import logging
import random
import resource
import shutil
import sys
import tempfile
import time
import traceback
import warnings
from contextlib import suppress
from pathlib import Path

SECONDS, MEMORY = 5.0, 1 << 30  # limits of one input


def peak() -> int:
    """Largest resident size in bytes since the last call of `forget_peak`."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM"):
            return 1024 * int(line.split()[1])
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def forget_peak() -> None:
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def try_input(read, files, folder: Path, start: int) -> str:
    """Read one input and return what is wrong, else ""."""
    from fuzz.containers import write
    from fuzz.targets import find_not_finite
    from scene_experts.core.errors import InputError

    shutil.rmtree(folder, ignore_errors=True)
    write(folder, files)
    forget_peak()
    began, wrong = time.process_time(), ""
    try:
        found = read(folder)
        if place := find_not_finite(found):
            wrong = f"accepted a number that is not finite in {place}"
    except InputError as error:
        text = str(error)
        if "\n" in text or not text.strip() or len(text) > 3000:
            wrong = f"an error that is no sentence: {text[:300]!r}"
    except Exception:
        wrong = traceback.format_exc(limit=-4)
    took, used = time.process_time() - began, peak() - start
    if took > SECONDS:
        wrong = wrong or f"{took:.1f} s"
    if used > MEMORY:
        wrong = wrong or f"{used / 2**30:.2f} GiB"
    return wrong


def main() -> None:
    names, seed, count, out = sys.argv[1].split(","), int(sys.argv[2]), int(sys.argv[3]), Path(sys.argv[4])
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    logging.disable(logging.CRITICAL)
    warnings.simplefilter("ignore")
    import torch

    torch.set_num_threads(1)
    for name in names:
        read_inputs(name, range(seed, seed + count), out)


def read_inputs(name: str, numbers: range, out: Path) -> None:
    """Read the inputs of one target and print what was wrong."""
    from fuzz.targets import STRUCTURED, TARGETS, make_seed, mutate_files

    target, most = TARGETS[name], resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    with tempfile.TemporaryDirectory() as scratch:
        files = make_seed(target, Path(scratch) / "valid")
        assert not (wrong := try_input(target.read, files, Path(scratch) / "valid", peak())), wrong
        start = int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + 3 * MEMORY, most))  # a bomb fails here before it takes the machine
        for number in numbers:
            rng = random.Random(f"{name} {number}")
            changed = mutate_files(files, target, rng, number >= STRUCTURED)
            if rng.random() < 0.3:
                changed = mutate_files(changed, target, rng, number >= STRUCTURED)
            (out / "current").write_text(f"{name} {number}")
            resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time() + 30), resource.RLIM_INFINITY))
            wrong = try_input(target.read, changed, out / "input", start)
            if wrong:
                print(json.dumps({"target": name, "number": number, "wrong": wrong}), flush=True)
    print(json.dumps({"target": name, "done": len(numbers)}), flush=True)


if __name__ == "__main__":
    main()
