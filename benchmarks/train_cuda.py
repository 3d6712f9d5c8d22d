"""Measure training on a GPU: time, peak memory and frames per second of recipes, and of as many explicit Gaussians on gsplat.

    python benchmarks/train_cuda.py --data CAPTURE --out DIR --seconds 500     # again and again until it prints the table

The script works in slices: each call continues where the last one stopped and ends after `--seconds`, including saving, so that it can
run on a machine that is available for minutes at a time. Each recipe is followed by a peer with as many Gaussians as its scene has with
positive opacity (mean over the held-out views), or `--count`, on the same machine; a finished peer is not trained again. `--torch-loss`
adds a peer with torch's SSIM, which is shown and not counted. Time is that of iterations, with prefetched photographs and without
compiling, saving and scoring. Peak memory is the peak of torch's allocator.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean, median
from typing import Any

import torch

import explicit_gsplat
from scene_experts.core.io import write_atomic
from scene_experts.core.transfer import upload
from scene_experts.core.types import Mode
from scene_experts.data.capture import Capture, load
from scene_experts.data.settings import Data
from scene_experts.evaluate import timing
from scene_experts.render import Rasterizer, choose
from scene_experts.training import loop as training
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.events import Finished, Stepped
from scene_experts.training.job import Job
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES
from scene_experts.training.state import Training, resume

SPARE = 25.0  # seconds of a slice reserved for saving
SCORING = 30.0  # seconds that must remain to start scoring


@dataclass(frozen=True)
class Peer:
    """So many explicit Gaussians. count 0: not known yet."""

    count: int
    loss: str = "triton"

    @property
    def name(self) -> str:
        return f"gsplat, {self.count:,}" + ("" if self.loss == "triton" else f", {self.loss} loss")


def make_parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of results.json, kept between slices")
    parser.add_argument("--seconds", type=float, default=500.0, help="length of this slice")
    parser.add_argument("--recipes", nargs="+", default=["scaffold-gs", "moe-gs"], choices=list(RECIPES), metavar="RECIPE")
    parser.add_argument("--iterations", type=int, default=30_000)
    parser.add_argument("--resolution", default="auto")
    parser.add_argument("--count", type=int, default=0, help="Gaussians of the peer; 0: as many as each recipe has")
    parser.add_argument("--torch-loss", action="store_true", help="also train peers with the loss of plain torch")
    parser.add_argument("--least-anchors", type=int, default=0, help="halve the voxels until a scene starts with so many anchors")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    return parser


def list_pending(recipes: Sequence[str], results: dict[str, Any], count: int = 0, losses: Sequence[str] = ("triton",)) -> list[str | Peer]:
    """The trainings left to do, in order: each recipe, then its peers, which need its number of Gaussians. count: of all peers."""
    left: list[str | Peer] = []
    for recipe in recipes:
        found = results.get(recipe, {})
        peers = [Peer(count or found.get("gaussians", 0), loss) for loss in losses]
        left += [] if found.get("done") else [recipe]
        left += [peer for peer in peers if peer not in left and not results.get(peer.name, {}).get("done")]
    return left


def main(argv: list[str] | None = None, draw: explicit_gsplat.Draw = explicit_gsplat.draw) -> int:
    args = make_parser().parse_args(argv)
    deadline = time.monotonic() + args.seconds - min(SPARE, args.seconds / 4)
    if args.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("expected a CUDA device, found none; run this on a machine with one")
    args.out.mkdir(parents=True, exist_ok=True)
    results = read_results(args)
    capture = load(Data(args.data, resolution=args.resolution))
    rasterize = choose("auto", args.device)
    losses = explicit_gsplat.LOSSES if args.torch_loss else ("triton",)
    while (left := list_pending(args.recipes, results, args.count, losses)) and time.monotonic() < deadline:
        job = left[0]
        name = job.name if isinstance(job, Peer) else job
        result = results.setdefault(name, {"peak_bytes": 0})
        if args.device == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats()
        if isinstance(job, Peer):
            train_peer(capture, job, args, deadline, result, draw)
        else:
            train_recipe(job, capture, rasterize, args, deadline, result)
        write_results(args, results)
        if not result.get("done"):  # the slice ends
            break
    capture.images.close()
    print(format_table(results, args.count))
    names = [job.name if isinstance(job, Peer) else job for job in left]
    print(f"to do: {'; '.join(names)}; run the same command again" if left else "all done")
    return 0


def read_results(args: argparse.Namespace) -> dict[str, Any]:
    """Read the results so far. Exits if they have other settings."""
    path, settings = (
        args.out / "results.json",
        {name: str(getattr(args, name)) for name in ("data", "iterations", "resolution", "device", "least_anchors")},
    )
    found = json.loads(path.read_text()) if path.is_file() else {"settings": settings}
    if found["settings"] != settings:
        raise SystemExit(f"expected the settings of {path} ({found['settings']}), found {settings}; give another --out")
    return found


def write_results(args: argparse.Namespace, results: dict[str, Any]) -> None:
    write_atomic(args.out / "results.json", lambda path: path.write_text(json.dumps(results, indent=1)))


def record_peak(args: argparse.Namespace, result: dict[str, Any]) -> None:
    """Add the peak memory of this slice to the result."""
    if args.device == "cuda":
        result["peak_bytes"] = max(result["peak_bytes"], torch.cuda.max_memory_allocated())


def train_recipe(
    name: str, capture: Capture, rasterize: Rasterizer, args: argparse.Namespace, deadline: float, result: dict[str, Any]
) -> None:
    """Continue a training, and score the scene when it is finished."""
    cfg: Train = replace(RECIPES[name][1], iterations=args.iterations)
    if args.least_anchors:
        cfg = replace(cfg, scene=refine_voxels(cfg.scene, capture, args.least_anchors))
    config = RunConfig(cfg, Data(args.data, resolution=args.resolution))
    if args.device == "cuda":  # compile the kernels of gsplat and Triton before timing: a few steps, dense and sparse
        short = replace(cfg, iterations=min(20, args.iterations))
        for _ in training.train(short, Job(replace(config, train=short), device=args.device), capture, rasterize):
            pass
        torch.cuda.reset_peak_memory_stats()
    options = TrainOptions(resume=True, save_every=10**9, keep_checkpoints=1, preview_every=0, log_every=100)
    run = Job(config, args.out / name, args.device, options=options)
    finished = False
    for event in training.train(cfg, run, capture, rasterize):
        if isinstance(event, Stepped):
            result |= {"step": event.step, "seconds": event.seconds, "anchors": event.anchors}
            if time.monotonic() > deadline:
                run.stop.append("end of the slice")
        if isinstance(event, Finished):
            finished, result["step"], result["seconds"] = True, event.step, event.seconds
    record_peak(args, result)
    if finished and time.monotonic() < deadline + min(SPARE, args.seconds / 4) - min(SCORING, args.seconds / 8):
        done = resume(cfg.scaled(), args.out / name / "checkpoints", args.device)
        assert done is not None
        result |= score(done, capture, rasterize, args.device) | {"done": True}


def refine_voxels(scene: Any, capture: Capture, least: int) -> Any:
    """Halve the voxels until a scene of anchors starts with `least` anchors, or until smaller voxels give no more."""
    assert capture.points is not None
    cameras, before = [capture.views[i].camera for i in capture.train], -1
    started = scene.start(capture.points, capture.extent, cameras)
    while before < 0.99 * len(started.table) and len(started.table) < least:
        before, scene = len(started.table), replace(scene, voxel_size=started.voxel / 2)
        started = scene.start(capture.points, capture.extent, cameras)
    return scene


@torch.no_grad()
def score(done: Training, capture: Capture, rasterize: Rasterizer, device: str) -> dict[str, Any]:
    """PSNR over held-out views, frames per second, and the number of Gaussians with positive opacity."""
    scene, active, psnr = done.scene, [], []
    background = upload(torch.tensor(capture.background), device)
    for index in capture.test or capture.train:
        camera = capture.views[index].camera.to(device)
        decoded = scene(camera, done.step, Mode.DRAW, rasterize.visible)
        if decoded.raw_opacity is not None:
            active.append(float((decoded.raw_opacity > 0).float().mean()))
        psnr.append(compute_psnr(rasterize(decoded.gaussians, camera, background).image, capture, index))
    cameras = [capture.views[i].camera.to(device) for i in capture.test or capture.train]
    speed = timing.measure_speed(scene, cameras, done.step, rasterize, background)
    count = round(len(scene.table) * scene.K * (mean(active) if active else 1.0))
    return {"psnr": mean(psnr), "fps": speed.fps, "decode_ms": speed.decode_ms, "raster_ms": speed.raster_ms, "gaussians": count}


def compute_psnr(image: torch.Tensor, capture: Capture, index: int) -> float:
    """PSNR of an image [H, W, 3] rounded to 8 bits."""
    target = capture.frame(index).rgb.to(image.device, torch.float32)
    mse = float(((image.clamp(0, 1) * 255 + 0.5).floor() - target).square().mean()) / 255**2
    return -10 * math.log10(max(mse, 1e-10))


def train_peer(
    capture: Capture, peer: Peer, args: argparse.Namespace, deadline: float, result: dict[str, Any], draw: explicit_gsplat.Draw
) -> None:
    """Continue the training of explicit Gaussians, and score it when it is finished."""
    made = explicit_gsplat.start(capture, peer.count, args.iterations, args.out, args.device, draw, peer.loss)
    finished = made.run(deadline)
    record_peak(args, result)
    result |= {"step": made.step, "seconds": made.seconds, "gaussians": peer.count}
    if not finished:
        return
    psnr, times = [], []
    with torch.no_grad():
        views = list(capture.test or capture.train)
        for index in views:
            psnr.append(compute_psnr(made.render(capture.views[index].camera), capture, index))
        for index in (views * math.ceil(37 / len(views)))[:37]:
            if args.device == "cuda":
                torch.cuda.synchronize()
            began = time.perf_counter()
            made.render(capture.views[index].camera)
            if args.device == "cuda":
                torch.cuda.synchronize()
            times.append(time.perf_counter() - began)
    result |= {"psnr": mean(psnr), "fps": 1 / median(times[5:]), "done": True}


def format_table(results: dict[str, Any], count: int = 0) -> str:
    """One line per training; the ratio of a recipe is to the peer with as many Gaussians, or with `count`, if it has run."""
    lines = [f"{'':32}{'steps':>8}{'time s':>10}{'ms/step':>9}{'of peer':>9}{'peak MiB':>10}{'FPS':>8}{'PSNR':>8}{'Gaussians':>11}"]
    for name, r in results.items():
        if name == "settings" or not r.get("step"):
            continue
        each = 1e3 * r["seconds"] / r["step"]
        base = results.get(Peer(count or r.get("gaussians", 0)).name, {})
        ratio = f"{each / (1e3 * base['seconds'] / base['step']):.2f}" if base.get("done") and "torch loss" not in name else ""
        cells = (r["step"], f"{r['seconds']:.1f}", f"{each:.2f}", ratio, f"{r['peak_bytes'] / 2**20:.0f}")
        late = [f"{r[key]:{form}}" if key in r else "" for key, form in (("fps", ".0f"), ("psnr", ".2f"), ("gaussians", ","))]
        lines.append(f"{name:32}" + "".join(f"{cell:>{w}}" for cell, w in zip((*cells, *late), (8, 10, 9, 9, 10, 8, 8, 11))))
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(main())
