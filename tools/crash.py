"""Kill trainings of every family at random moments, resume them, and compare the end with trainings that were left alone, bit for bit.

    python tools/crash.py --rounds 200 --seed 1

Exit code 1 with the first difference. The work is in tests/support/crashes.py.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # forks must not inherit threads
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=200, help="number of kills (default: 200)")
    parser.add_argument("--seed", type=int, default=0, help="seed of the moments (default: 0)")
    args = parser.parse_args()
    from support.crashes import Crashes  # pyright: ignore[reportMissingImports]
    from support.synthetic import make_capture  # pyright: ignore[reportMissingImports]

    began = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="crash-") as folder:
        capture = make_capture(Path(folder) / "capture", views=5, size=(32, 24), points=100).folder
        count = Crashes(capture, Path(folder), args.seed).run(args.rounds)
    used = sum(os.times()[:4])
    print(", ".join(f"{name}: {number}" for name, number in count.items()) + f"; {time.monotonic() - began:.0f} s, {used:.0f} s CPU")
    return 0


if __name__ == "__main__":
    sys.exit(main())
