"""Render a held-out view of a run, with its photograph on the left.

python examples/render_one_view.py RUN view.png
"""

import argparse

import numpy as np
from PIL import Image

import scene_experts as se

parser = argparse.ArgumentParser()
parser.add_argument("run")
parser.add_argument("out")
arguments = parser.parse_args()

run = se.open_run(arguments.run)
camera = run.test_cameras[0]
both = np.hstack([run.capture.photo(camera), run.render(camera)])  # float32 [H, 2 W, 3] in [0, 1]
Image.fromarray((255 * both + 0.5).astype(np.uint8)).save(arguments.out)
