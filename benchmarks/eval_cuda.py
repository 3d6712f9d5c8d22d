"""Time `eval` on a GPU: train a recipe for some iterations, score its held-out views twice, and report the second time.

python benchmarks/eval_cuda.py --data CAPTURE --out DIR
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

from scene_experts.cli import main as run


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run, replaced")
    parser.add_argument("--recipe", default="scene-experts")
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--resolution", default="auto")
    parser.add_argument("--device", default="cuda")
    args = parser.parse_args(argv)
    words = ["--iterations", str(args.iterations), "--resolution", args.resolution, "--device", args.device, "--overwrite"]
    if code := run(["train", args.recipe, "--data", str(args.data), "--out", str(args.out), *words]):
        return code
    for turn in ("first", "second"):
        began = time.perf_counter()
        if code := run(["eval", str(args.out), "--no-lpips", "--device", args.device]):
            return code
        seconds, views = time.perf_counter() - began, len(json.loads((args.out / "per_view.json").read_text()))
        print(f"eval, the {turn} time: {views} views in {seconds:.1f} s, {seconds / max(views, 1):.3f} s a view", flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
