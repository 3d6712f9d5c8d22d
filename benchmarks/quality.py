"""Train and score recipes on captures, one after the other, and print a table.

Usage: python benchmarks/quality.py --captures DIR... [--recipes scaffold-gs moe-gs] [--iterations 7000] [--seeds 0] [--out runs/quality]
Finished runs are not repeated and interrupted runs continue, so the command can be repeated until the table is complete.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import sys
from pathlib import Path

COLUMNS = (
    ("PSNR", lambda r: f"{r['psnr']:.2f}"),
    ("SSIM", lambda r: f"{r['ssim']:.3f}"),
    ("LPIPS", lambda r: format_score(r, "lpips")),
    ("LPIPS 3dgs", lambda r: format_score(r, "lpips_3dgs")),
    ("MB", lambda r: f"{r['size']['MB']:.1f}"),
    ("anchors", lambda r: f"{r['anchors']:,}"),
    ("active %", lambda r: "-" if r["activation_ratio"] is None else f"{100 * r['activation_ratio']:.1f}"),  # 3DGS has no such share
    ("sharpness", lambda r: "-" if r["sharpness"]["ratio"] is None else f"{r['sharpness']['ratio']:.2f}"),
    ("FPS", lambda r: f"{r['fps']['fps']:.0f}"),
    ("training", lambda r: f"{r['train_seconds'] / 60:.1f} min"),
)


def format_score(results: dict, name: str) -> str:
    return "-" if results.get(name) is None else f"{results[name]:.3f}"


def run(args: list[str]) -> None:
    print("$ scene-experts", *args, flush=True)
    subprocess.run([sys.executable, "-m", "scene_experts", *args], check=True)


def run_one(capture: Path, recipe: str, seed: int, iterations: int, folder: Path, extra: list[str]) -> dict:
    """The results of one run; trains and scores it if they do not exist. Exits if the folder has a run with other options."""
    results, config = folder / "results.json", folder / "config.json"
    train = ["train", recipe, "--data", str(capture), "--out", str(folder), "--iterations", str(iterations), "--seed", str(seed)]
    train += ["--preview-every", "0", *extra]
    wanted = shlex.join(["scene-experts", *train])
    if config.exists() and (found := json.loads(config.read_text())["command"]) != wanted:
        raise SystemExit(f"expected the run of `{wanted}` in {folder}, found that of `{found}`; give another --out")
    if not results.exists():
        run([*train, *(["--resume"] if (folder / "checkpoints").exists() else [])])
        run(["eval", str(folder)])
    return json.loads(results.read_text())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--captures", type=Path, nargs="+", required=True)
    parser.add_argument("--recipes", nargs="+", default=["scaffold-gs", "moe-gs"])
    parser.add_argument("--iterations", type=int, default=7000)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--out", type=Path, default=Path("runs/quality"))
    args, extra = parser.parse_known_args()
    rows = []
    for capture in args.captures:
        for recipe in args.recipes:
            for seed in args.seeds:
                name = recipe if len(args.seeds) == 1 else f"{recipe}-seed{seed}"
                results = run_one(capture, recipe, seed, args.iterations, args.out / capture.name / name, extra)
                rows.append([capture.name, name, *(render(results) for _, render in COLUMNS)])
    heads = ["capture", "recipe", *(name for name, _ in COLUMNS)]
    print("\n| " + " | ".join(heads) + " |\n|" + "---|" * len(heads))
    print("\n".join("| " + " | ".join(row) + " |" for row in rows))


if __name__ == "__main__":
    main()
