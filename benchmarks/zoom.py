"""PSNR of held-out views at other resolutions than that of the training: what the 3D smoothing filter does when a camera comes closer.

Usage: python benchmarks/zoom.py CAPTURE [--recipe scene-experts] [--smoothing 0 0.2] [--train 400] [--score 200 400 800]
    [--iterations 3000]
Resolutions are those of the longest side, pixels. One training for each value of --smoothing; nothing is kept.
"""

from __future__ import annotations

import argparse
import statistics
import sys
from pathlib import Path

import numpy as np

import scene_experts as se


def psnr(run: se.Run, capture: se.Capture) -> float:
    """Mean PSNR in dB of 8-bit pictures of the held-out views of a capture."""
    scores = []
    for camera in capture.test_cameras:
        picture = np.round(255 * run.render(camera)) / 255
        scores.append(-10 * np.log10(np.square(picture - capture.photo(camera), dtype=np.float64).mean()))
    return statistics.fmean(scores)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path)
    parser.add_argument("--recipe", default="scene-experts")
    parser.add_argument("--smoothing", type=float, nargs="+", default=[0.0, 0.2])
    parser.add_argument("--train", type=int, default=400)
    parser.add_argument("--score", type=int, nargs="+", default=[200, 400, 800])
    parser.add_argument("--iterations", type=int, default=3000)
    args = parser.parse_args()
    photographs = {size: se.load_capture(args.capture, resolution=f"longest:{size}") for size in {args.train, *args.score}}
    print("| capture | smoothing | " + " | ".join(f"PSNR at {size} px" for size in args.score) + " | anchors |")
    print("|" + "---|" * (len(args.score) + 3))
    for smoothing in args.smoothing:
        recipe = se.recipe(args.recipe, iterations=args.iterations, **{"scene.smoothing": smoothing})
        run = se.train(recipe, photographs[args.train], progress=False)
        scores = [f"{psnr(run, photographs[size]):.2f}" for size in args.score]
        print(f"| {args.capture.name} | {smoothing:g} | {' | '.join(scores)} | {len(run.scene.positions):,} |")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
