"""How the time of `capture` grows with the number of photographs: a walk drawn from a trained scene.

    python benchmarks/walk.py RUN --out OUT [--counts 128 256 400] [--side 800] [--json FILE]

The walk goes along the training cameras of RUN in the order of their names. Each count takes as many
pictures of the same walk, evenly spaced, and runs `capture` on them with one thread. Prints the CPU
seconds of each stage, the exponent of each stage from one count to the next (1: linear, 2: all
pairs), the poses found, and how far the camera centres are from the true ones after a similarity
transform. Pictures that are there are not drawn again.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import os
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image

import scene_experts as se
from scene_experts.data.readers.colmap_model import find_models, read_model
from scene_experts.geometry.poses import interpolate_poses
from scene_experts.geometry.rotation import quat_to_matrix
from scene_experts.sfm.options import SfmOptions
from scene_experts.sfm.reconstruct import reconstruct

TICKS = os.sysconf("SC_CLK_TCK")


def cpu_seconds() -> float:
    """Return the CPU seconds of this process and of its living children."""
    pids = [os.getpid()]
    for task in Path("/proc/self/task").iterdir():
        pids += [int(pid) for pid in (task / "children").read_text().split()]
    total = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += int(fields[11]) + int(fields[12])
    return total / TICKS


class Stages:
    """The CPU seconds of each work that `capture` tells of; the rest counts for the work before."""

    def __init__(self) -> None:
        self.seconds: Counter[str] = Counter()
        self.name, self.since = "start", cpu_seconds()

    def tell(self, name: str, done: int = 0, total: int = 0) -> None:
        now = cpu_seconds()
        self.seconds[self.name] += max(0.0, now - self.since)  # a child that ended takes its seconds with it
        self.name, self.since = name.split(" (")[0], now


def draw_walk(run: se.Run, count: int, side: int, folder: Path) -> np.ndarray:
    """Draw pictures along the walk. Returns the centres [count, 3]."""
    cameras = run.train_cameras
    positions = torch.from_numpy(np.stack([camera.position for camera in cameras]))
    turns = torch.from_numpy(np.stack([camera.world_to_camera[:3, :3].T for camera in cameras]))
    lens = cameras[len(cameras) // 2]
    scale = side / max(lens.width, lens.height)
    width, height = round(scale * lens.width), round(scale * lens.height)
    centres = []
    for i, pose in enumerate(interpolate_poses(positions, turns, count)):
        camera = se.Camera.from_pose(
            np.linalg.inv(pose.numpy()), width=width, height=height, fx=scale * lens.K[0, 0], cx=width / 2, cy=height / 2
        )
        centres.append(camera.position)
        place = folder / f"{i:04d}.jpg"
        if not place.is_file():
            folder.mkdir(parents=True, exist_ok=True)
            Image.fromarray((255 * run.render(camera).clip(0, 1) + 0.5).astype(np.uint8)).save(place, quality=95)
    return np.stack(centres)


def centre_errors(capture: Path, true: np.ndarray) -> np.ndarray:
    """Return how far the centres found are from the true ones, in % of the largest distance of two
    of those, after a similarity transform (Umeyama 1991)."""
    images = read_model(find_models(capture)[0]).images
    found = []
    for image in images:
        turn = quat_to_matrix(torch.tensor(image.quaternion, dtype=torch.float64)[None])[0].numpy()
        found.append(-turn.T @ np.array(image.translation))
    a, b = np.stack(found), true[[int(image.name.split(".")[0]) for image in images]]
    spread = np.linalg.norm(b[:, None] - b[None], axis=2).max()
    a, b = a - a.mean(0), b - b.mean(0)
    u, sizes, vh = np.linalg.svd(b.T @ a)
    sign = np.array([1.0, 1.0, np.linalg.det(u @ vh)])
    turn, scale = u @ np.diag(sign) @ vh, (sizes * sign).sum() / np.square(a).sum()
    return 100 * np.linalg.norm(scale * a @ turn.T - b, axis=1) / spread


def measure(run: se.Run, count: int, side: int, out: Path) -> dict[str, Any]:
    """Draw a walk and find its poses."""
    true = draw_walk(run, count, side, out / f"walk{count}")
    capture, stages, said = out / f"capture{count}", Stages(), []
    shutil.rmtree(capture, ignore_errors=True)
    note = reconstruct(out / f"walk{count}", capture, SfmOptions(threads=1), say=said.append, progress=stages.tell)
    stages.tell("end")
    pairs = next((line for line in said if "pairs to match" in line), "")
    errors = centre_errors(capture, true)
    return {
        "count": count,
        "stages": dict(stages.seconds),
        "poses": note["with_pose"],
        "median_error_percent": float(np.median(errors)),
        "error_95_percent": float(np.quantile(errors, 0.95)),
        "pairs": pairs,
    }


def show(rows: list[dict[str, Any]]) -> None:
    """Print a table of the stages, with exponents."""
    for row in rows:
        off = f"centres off by {row['median_error_percent']:.3f} % in the median, {row['error_95_percent']:.3f} % at 95 %"
        print(f"{row['count']}: {row['pairs']}; {row['poses']} poses, {off}")
    for name in dict.fromkeys(name for row in rows for name in row["stages"]):
        points = [(row["count"], row["stages"].get(name, 0.0)) for row in rows]
        slopes = [exponent(*pair) for pair in itertools.pairwise(points)]
        print(f"{name}: {', '.join(f'{seconds:.1f}' for _, seconds in points)} CPU s; exponents {', '.join(f'{e:.2f}' for e in slopes)}")


def exponent(before: tuple[int, float], after: tuple[int, float]) -> float:
    """Return e of seconds = c count^e through two points (count, seconds)."""
    if before[1] <= 0 or after[1] <= 0:
        return math.nan
    return math.log(after[1] / before[1]) / math.log(after[0] / before[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--counts", type=int, nargs="+", default=[128, 256, 400])
    parser.add_argument("--side", type=int, default=800, help="longer side of a picture, px")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    run, rows = se.open_run(args.run), []
    for count in args.counts:
        rows.append(measure(run, count, args.side, args.out))
        show(rows[-1:])
        if args.json:
            args.json.write_text(json.dumps(rows, indent=1) + "\n")
    show(rows)


if __name__ == "__main__":
    main()
