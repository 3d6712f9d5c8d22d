"""A scene in blocks against the same training in one piece: plan, trainings, merge, joint training and scores.

    python benchmarks/blocks.py CAPTURE --out OUT --seed 0 --blocks 4 --iterations 3000 --plan="--resolution longest:400"

Rows of the table: the run in one piece; the merged scene; the merged scene after the joint training; and the control, the run in one
piece after the same further training. The commands of the blocks are those of `scene-experts blocks plan`. The coarse scene is the
checkpoint of the run in one piece at its iteration, as both have the same commands up to there; --own-coarse trains it apart. What is in
OUT already is not made again, so a stopped comparison goes on; the CPU seconds of a training that was stopped are those since its last
start. "GiB" is the largest resident memory of a process of the row.
"""

from __future__ import annotations

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

PROGRAM = [sys.executable, "-m", "scene_experts"]


def run(out: Path, name: str, words: list[str]) -> None:
    """Run a command once; OUT/name.json keeps its words, CPU seconds and largest resident memory. A training goes on where it stopped.

    Exits if the command of OUT/name.json is another one.
    """
    record = out / f"{name}.json"
    if record.exists():
        done = shlex.split(json.loads(record.read_text())["command"])
        if [word for word in done if word != "--resume"] != words:
            raise SystemExit(f"expected `{shlex.join(words)}` in {record}, found `{shlex.join(done)}`; give another --out")
        return
    if words[0] == "train" and (Path(words[words.index("--out") + 1]) / "checkpoints").exists():
        words = [*words, "--resume"]
    print(time.strftime("%H:%M:%S"), shlex.join(words), flush=True)
    with (out / f"{name}.log").open("ab") as log:
        process = subprocess.Popen([*PROGRAM, *words], stdout=log, stderr=log)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"failed with exit code {process.returncode}: see {out / name}.log")
    cost = {"cpu_seconds": round(usage.ru_utime + usage.ru_stime, 1), "gib": round(usage.ru_maxrss / 2**20, 2)}
    record.write_text(json.dumps({"command": shlex.join(words), **cost}))


def replace_options(words: list[str], new: list[str]) -> list[str]:
    """Return a command with new options, each of one value, in the place of its own of the same name."""
    kept = list(words)
    for option in new[::2]:
        if option in kept:
            at = kept.index(option)
            del kept[at : at + 2]
    return kept + new


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("capture", type=Path)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--recipe", default="moe-gs")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--blocks", type=int, default=4)
    parser.add_argument("--iterations", type=int, default=3000)
    parser.add_argument("--threads", type=int, default=1, help="of each training")
    parser.add_argument("--train", default="", help="more options of all trainings, in quotes after =")
    parser.add_argument("--plan", default="", help="more options of blocks plan, in quotes after =")
    parser.add_argument("--whole", default="", help="more options of the run in one piece, each with one value")
    parser.add_argument("--own-coarse", action="store_true", help="train the coarse scene apart from the run in one piece")
    parser.add_argument("--no-control", action="store_true", help="leave out the run in one piece after the joint training's iterations")
    args = parser.parse_args()
    out, plan = args.out, args.out / "plan"
    out.mkdir(parents=True, exist_ok=True)
    os.environ["OMP_NUM_THREADS"] = str(args.threads)
    options = f"--seed {args.seed} {args.train}".strip()
    words = ["--blocks", str(args.blocks), "--recipe", args.recipe, "--iterations", str(args.iterations), *shlex.split(args.plan)]
    run(out, "make_plan", ["blocks", "plan", str(args.capture), "--out", str(plan), *words, f"--train={options}"])
    coarse, *blocks, merge, joint = (shlex.split(line)[1:] for line in (plan / "commands.sh").read_text().splitlines()[2:])
    at = coarse.index("--stop-at")
    whole = replace_options(coarse[:at] + coarse[at + 2 :], ["--out", str(out / "whole"), *shlex.split(args.whole)])
    if not args.own_coarse:
        if not (plan / "coarse").exists():
            run(out, "coarse", [*whole, *coarse[at : at + 2]])
            shutil.copytree(out / "whole", out / "copy")
            (out / "copy").rename(plan / "coarse")
    else:
        run(out, "coarse", coarse)
    run(out, "whole", whole)
    for number, words in enumerate(blocks):
        run(out, f"run{number}", words)
    run(out, "merge", merge)
    run(out, "joint", joint)
    rows = {"in one piece": out / "whole", "merged": plan / "merged", "merged, and together": plan / "joint"}
    if not args.no_control:
        run(out, "further", replace_options(joint, ["--out", str(out / "further"), "--init-from", str(out / "whole")]))
        rows["in one piece, and further"] = out / "further"
    for folder in rows.values():
        run(out, f"eval_{folder.name}", ["eval", str(folder), "--no-lpips"])
    print_table(out, rows, len(blocks))


def print_table(out: Path, rows: dict[str, Path], blocks: int) -> None:
    """Print the rows as Markdown. CPU seconds and memory are those of all trainings that a row needs."""
    stages = {"whole": ["coarse", "whole"], "merged": ["coarse", *(f"run{n}" for n in range(blocks)), "merge"]}
    stages |= {"joint": [*stages["merged"], "joint"], "further": [*stages["whole"], "further"]}
    print("| run | PSNR | SSIM | anchors | CPU s | GiB |\n|---|---|---|---|---|---|")
    for name, folder in rows.items():
        results: dict[str, Any] = json.loads((folder / "results.json").read_text())
        costs = [json.loads((out / f"{stage}.json").read_text()) for stage in stages[folder.name]]
        seconds, gib = sum(cost["cpu_seconds"] for cost in costs), max(cost["gib"] for cost in costs)
        scores = f"{results['psnr']:.2f} | {results['ssim']:.3f} | {results['anchors']:,}"
        print(f"| {name} | {scores} | {seconds:.0f} | {gib:.2f} |", flush=True)


if __name__ == "__main__":
    main()
