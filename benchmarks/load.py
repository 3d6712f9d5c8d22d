"""Time and memory of loading a capture of many photographs with masks, in two checkouts.

Usage: python benchmarks/load.py OTHER_PYTHON [--views 2000] [--rounds 5]
OTHER_PYTHON is the interpreter of the other checkout's environment. The checkouts take turns, each load in a new process; the order of a
pair alternates. CPU seconds are minima, memory is the largest resident set above that after the imports. No pixel is asked for.
"""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

LOAD = """
import json, resource, sys, time
from pathlib import Path
from scene_experts.data import capture
from scene_experts.data.settings import Data
before, began = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
found = capture.load(Data(Path(sys.argv[1]), split="mod8"))
seconds = time.process_time() - began
masks = sum(source.mask is not None for source in found.images.sources)
print(json.dumps([seconds, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) / 1024, len(found.views), masks]))
"""


def make_capture(folder: Path, views: int, points: int = 100_000) -> None:
    """Write a COLMAP model of cameras on a circle, with photographs of 800 x 600 px and masks of black and white."""
    from scene_experts.data.lens import Lens
    from scene_experts.data.readers.colmap_model import ColmapImage, Model, write_model

    rng = np.random.default_rng(0)
    (folder / "images").mkdir(parents=True)
    (folder / "masks").mkdir()
    posed = []
    for i in range(views):
        half = np.pi * i / views
        posed.append(ColmapImage(i + 1, f"{i:05d}.jpg", (float(np.cos(half)), 0.0, float(np.sin(half)), 0.0), (0.0, 0.0, 4.0), 1))
    lens = Lens("PINHOLE", 800, 600, (700.0, 700.0, 400.0, 300.0))
    xyz = rng.normal(size=(points, 3))
    model = Model(
        {1: lens}, tuple(posed), np.arange(1, points + 1), xyz, rng.integers(0, 256, (points, 3)).astype(np.uint8), np.ones(points)
    )
    write_model(folder / "sparse/0", model)
    picture = Image.fromarray(rng.integers(0, 256, (75, 100, 3)).astype(np.uint8)).resize((800, 600))
    mask = np.full((600, 800), 255, np.uint8)
    mask[200:400, 300:500] = 0
    picture.save(folder / "images/00000.jpg")
    Image.fromarray(mask).save(folder / "masks/00000.png")
    for i in range(1, views):
        shutil.copy(folder / "images/00000.jpg", folder / f"images/{i:05d}.jpg")
        shutil.copy(folder / "masks/00000.png", folder / f"masks/{i:05d}.png")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other")
    parser.add_argument("--views", type=int, default=2000)
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as room:
        make_capture(Path(room) / "c", args.views)
        found: dict[str, list[list[float]]] = {"this": [], "other": []}
        for turn in range(args.rounds):
            pair = [("this", sys.executable), ("other", args.other)]
            for name, python in pair if turn % 2 else reversed(pair):
                done = subprocess.run([python, "-c", LOAD, str(Path(room) / "c")], capture_output=True, text=True, check=True)
                found[name].append(json.loads(done.stdout))
    for name, rows in found.items():
        seconds, memory, views, masks = rows[0]
        seconds, memory = min(row[0] for row in rows), min(row[1] for row in rows)
        print(f"{name:>6}: {seconds:.2f} CPU s, {memory:.0f} MiB, {views:.0f} views, {masks:.0f} masks")


if __name__ == "__main__":
    main()
