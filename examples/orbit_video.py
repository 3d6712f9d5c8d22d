"""Fly once around a scene in a video.

python examples/orbit_video.py RUN orbit.mp4
"""

import argparse

import scene_experts as se

parser = argparse.ArgumentParser()
parser.add_argument("run")
parser.add_argument("out", help="FILE.mp4, or a folder for PNG files")
parser.add_argument("--frames", type=int, default=192)
parser.add_argument("--width", type=int, default=640)
parser.add_argument("--height", type=int, default=360)
parser.add_argument("--show", default="picture", help="picture, depth, alpha, experts, entropy or activation")
arguments = parser.parse_args()

run = se.open_run(arguments.run)
cameras = run.capture.camera_path("orbit", frames=arguments.frames, size=(arguments.width, arguments.height))
run.write_video(arguments.out, cameras, fps=24, show=arguments.show)
