"""Make a capture with depth maps, as a phone with LiDAR writes them, out of one that has none.

    python benchmarks/depth_capture.py CAPTURE RUN OUT --views 20
    scene-experts reproduce compare --recipes one-network "no depth=one-network --loss.depth 0" \\
        --captures OUT --folds 5 --iterations 3000 --resolution longest:400

RUN has the scene that a training on many photographs of CAPTURE found. Its depth is drawn for evenly
chosen views, and made worse as a sensor does: 256 pixels wide, beyond its range unknown, each value
1 % off and each map 0.5 %, both at random. The photographs are undistorted; there are no other
points. OUT is a capture of nerfstudio.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image

import scene_experts as se

WIDTH = 256  # px of the longer side of a map
RANGE = 0.9  # share of the depths that the sensor reaches
NOISE, BIAS = 0.01, 0.005  # relative standard deviations, of a value and of a map
DEEPEST = 60.0  # units of the capture that the deepest value becomes: 16 bits hold 65.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("run", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--resolution", default="longest:800")
    args = parser.parse_args()
    capture = se.load_capture(args.capture, resolution=args.resolution, split="none", max_views=args.views)
    run, rng = se.open_run(args.run), np.random.default_rng(0)
    maps = [draw_map(run, camera) for camera in capture.cameras]
    known = np.concatenate([depth[depth > 0] for depth in maps])
    farthest = float(np.quantile(known, RANGE))
    scale = DEEPEST / max(farthest * 1.1, 1e-9)  # of the capture, so that a millimetre is small
    for folder in ("images", "depth"):
        (args.out / folder).mkdir(parents=True)
    frames = []
    for index, (camera, depth) in enumerate(zip(capture.cameras, maps)):
        measured = depth * (1 + NOISE * rng.standard_normal(depth.shape)) * (1 + BIAS * rng.standard_normal())
        measured[(depth <= 0) | (depth > farthest)] = 0
        name = f"{index:03d}"
        Image.fromarray((255 * capture.photo(index)).round().astype(np.uint8)).save(args.out / f"images/{name}.png")
        Image.fromarray((1000 * scale * measured).round().astype(np.uint16)).save(args.out / f"depth/{name}.png")
        pose = np.linalg.inv(camera.world_to_camera)
        pose[:3, 1:3] *= -1  # y up, z back
        pose[:3, 3] *= scale
        frames.append(
            {
                "file_path": f"images/{name}.png",
                "depth_file_path": f"depth/{name}.png",
                "transform_matrix": pose.tolist(),
                "w": camera.width,
                "h": camera.height,
                **{key: float(value) for key, value in zip(("fl_x", "fl_y", "cx", "cy"), camera.K[[0, 1, 0, 1], [0, 1, 2, 2]])},
            }
        )
    (args.out / "transforms.json").write_text(json.dumps({"camera_model": "OPENCV", "frames": frames}))
    print(f"{args.out}: {len(frames)} views, depth of {np.mean([np.mean((d > 0) & (d <= farthest)) for d in maps]):.0%} of their pixels")


def draw_map(run: se.Run, camera: se.Camera) -> np.ndarray:
    """Return the depth of the run's scene at the resolution of a sensor; 0 where it is not opaque."""
    share = WIDTH / max(camera.width, camera.height)
    width, height = round(camera.width * share), round(camera.height * share)
    K = camera.K * np.array([[width / camera.width], [height / camera.height], [1.0]])
    layers = run.render_layers(replace(camera, K=K, width=width, height=height))
    return np.where(layers.alpha > 0.9, layers.depth, 0.0)


if __name__ == "__main__":
    main()
