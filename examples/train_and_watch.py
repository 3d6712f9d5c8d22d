"""Train, print the PSNR of a held-out view, and stop once it falls. The view is then no fair test: score such a run on others.

python examples/train_and_watch.py CAPTURE RUN --iterations 7000
"""

import argparse

import numpy as np

import scene_experts as se

parser = argparse.ArgumentParser()
parser.add_argument("capture")
parser.add_argument("run")
parser.add_argument("--iterations", type=int, default=7000)
parser.add_argument("--every", type=int, default=500, help="iterations between two looks")
arguments = parser.parse_args()

capture = se.load_capture(arguments.capture)
if not capture.test_cameras:  # few photographs: by default all are trained on
    capture = se.load_capture(arguments.capture, split="mod8")
recipe = se.recipe("moe-gs", iterations=arguments.iterations)
trainer = se.Trainer(recipe, capture, arguments.run, preview_every=arguments.every)
best = 0.0
for event in trainer:
    if isinstance(event, se.Previewed):
        psnr = -10 * np.log10(np.mean((event.picture.numpy() - trainer.capture.photo(event.view)) ** 2))
        print(f"iteration {event.step}: {psnr:.2f} dB")
        if psnr < best - 0.5:
            trainer.stop("no longer better")
        best = max(best, psnr)
