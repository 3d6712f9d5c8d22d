"""Race OpenSplat's CPU build: the same photographs, threads and held-out views, one scorer.

    python benchmarks/opensplat.py OPENSPLAT [--capture demo/banana] [--side 600] [--threads 2] [--iterations 1300] [--peer-iterations 2000]
        [--peer-flags "--warmup-length 250"] [--recipe moe-gs] [--out FOLDER]

OPENSPLAT is the path of its program, built with a CPU build of libtorch. Its code (AGPL) is no part of this project. Both programs get
photographs of `side` pixels. OpenSplat gets a folder with the training views alone; its PLY is imported and scored like our run. Times
are wall times of whole programs, one after the other, so use an idle machine. The capture must have pinhole cameras.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from PIL import Image

from scene_experts.data.capture import load
from scene_experts.data.lens import Lens
from scene_experts.data.readers.colmap_model import find_models, read_model, write_model
from scene_experts.data.settings import Data

LIMIT = 6 * 3600  # seconds of one program


def write_training_views(capture: Path, side: int, out: Path) -> int:
    """Write the training views, resized, as a COLMAP folder in the capture's own frame. Returns their number."""
    small, found = load(Data(capture, resolution=f"longest:{side}")), next(iter(find_models(capture)), None)
    if found is None:
        raise SystemExit(f"expected a COLMAP folder, found none in {capture}; give one with sparse/0")
    model = read_model(found)
    by_name = {image.name: image for image in model.images}
    (out / "images").mkdir(parents=True)
    (out / "sparse" / "0").mkdir(parents=True)
    images, cameras = [], {}
    for number, index in enumerate(small.train, 1):
        view = small.views[index]
        K = view.camera.K.tolist()
        name = f"{Path(view.name).stem}.png"
        Image.fromarray(small.frame(index).rgb.numpy()).save(out / "images" / name)
        cameras[number] = Lens("PINHOLE", view.camera.width, view.camera.height, (K[0][0], K[1][1], K[0][2], K[1][2]))
        images.append(replace(by_name[view.name], id=number, name=name, camera_id=number))
    write_model(out / "sparse" / "0", replace(model, cameras=cameras, images=tuple(images), observations={}))
    return len(images)


def timed(command: list[str], threads: int) -> float:
    """Run a program with this number of threads and return its wall time in seconds."""
    env = os.environ | {"OMP_NUM_THREADS": str(threads), "MKL_NUM_THREADS": str(threads)}
    began = time.perf_counter()
    done = subprocess.run(command, env=env, capture_output=True, text=True, timeout=LIMIT)
    if done.returncode:
        raise SystemExit(f"`{shlex.join(command)}` ended with {done.returncode}:\n{(done.stdout + done.stderr)[-2000:]}")
    return time.perf_counter() - began


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("opensplat", type=Path)
    parser.add_argument("--capture", type=Path, default=Path("demo/banana"))
    parser.add_argument("--side", type=int, default=600)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--recipe", default="moe-gs")
    parser.add_argument("--iterations", type=int, default=1300)
    parser.add_argument("--peer-iterations", type=int, default=2000)
    parser.add_argument("--peer-flags", default="")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    out = args.out or Path(tempfile.mkdtemp())
    ours, theirs, ply = out / "ours", out / "theirs", out / "opensplat.ply"
    views = write_training_views(args.capture, args.side, out / "training_views")
    program = [sys.executable, "-m", "scene_experts"]
    places = ["--data", str(args.capture), "--resolution", f"longest:{args.side}"]
    seconds = {
        ours: timed(
            [*program, "train", args.recipe, *places, "--out", str(ours), "--iterations", str(args.iterations), "--preview-every", "0"],
            args.threads,
        ),
        theirs: timed(
            [str(args.opensplat), str(out / "training_views"), "-n", str(args.peer_iterations), "-d", "1", "-o", str(ply), "--keep-crs"]
            + shlex.split(args.peer_flags),
            args.threads,
        ),
    }
    timed([*program, "import", str(ply), *places, "--out", str(theirs)], args.threads)
    print(f"{views} training views of {args.side} px, {args.threads} threads")
    print(f"{'':32}{'s':>8}{'PSNR':>8}{'LPIPS':>8}")
    names = {ours: f"{args.recipe}, {args.iterations} iterations", theirs: f"OpenSplat, {args.peer_iterations} iterations"}
    for run, name in names.items():
        timed([*program, "eval", str(run)], args.threads)
        found = json.loads((run / "results.json").read_text())
        lpips = f"{found['lpips']:8.3f}" if found.get("lpips") is not None else f"{'-':>8}"
        print(f"{name:32}{seconds[run]:8.0f}{found['psnr']:8.2f}{lpips}")


if __name__ == "__main__":
    main()
