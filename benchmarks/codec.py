"""How fast a compact file of a run is written and read, on one core.

    OMP_NUM_THREADS=1 python benchmarks/codec.py RUN

Writes the run's compact file, and prints the CPU seconds to fit its models, to code it with them and
to decode it, and anchors per second: the least of several turns. Peer: zlib, level 9, of the file
that holds the same scene as it is (--format anchors).
"""

from __future__ import annotations

import argparse
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import scene_experts as se
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import opening
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.codec.fit import fit_models

TURNS = 7


def least(work: Callable[[], object]) -> float:
    """Return the least CPU seconds of some turns."""
    seconds = []
    for _ in range(TURNS):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return min(seconds)


def written(run: se.Run, folder: Path) -> tuple[AnchorData, bytes, Path]:
    """The scene as it is given to the codec, with its precision, the bytes of its compact file, and
    the exact file."""
    given: list[AnchorData] = []
    encode = compact.encode

    def kept(data: AnchorData) -> Any:
        given.append(data)
        return encode(data)

    compact.encode = kept
    try:
        file = run.export("compact", folder / "scene.compact")
    finally:
        compact.encode = encode
    exact = run.export("anchors", folder / "exact")
    return given[-1], file.read_bytes(), exact


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data, file, exact = written(se.open_run(args.run), Path(folder))
        plain = b"".join(part.read_bytes() for part in sorted(exact.rglob("*")) if part.is_file()) if exact.is_dir() else exact.read_bytes()
        n, found = len(data.columns["xyz"]), compact.arrange(data)
        models = fit_models(found.groups, found.way, found.whole.values)
        rows = {"fit": least(lambda: fit_models(found.groups, found.way, found.whole.values))}
        fitted = compact.fit_models
        compact.fit_models = lambda *_: models
        rows["code"] = least(lambda: compact.encode(data))
        compact.fit_models = fitted
        seconds = []
        for _ in range(TURNS):  # each reads with a budget of its own
            with opening(Path(folder) / "scene.compact", budget.COMPACT) as source:
                began = time.process_time()
                compact.decode(file, source)
                seconds.append(time.process_time() - began)
        rows["decode"] = min(seconds)
        packed = zlib.compress(plain, 9)
        rows["zlib, pack"], rows["zlib, unpack"] = least(lambda: zlib.compress(plain, 9)), least(lambda: zlib.decompress(packed))
    print(f"{n:,} anchors; {len(file):,} bytes, exact {len(plain):,}, by zlib {len(packed):,}")
    for name, value in rows.items():
        print(f"{name}: {value:.3f} CPU s, {n / value / 1e6:.2f} M anchors/s")


if __name__ == "__main__":
    main()
