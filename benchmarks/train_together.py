"""Train several recipes side by side on one machine, stop all at a step that each has reached, and score them there.

    python benchmarks/train_together.py --data CAPTURE --trainings FILE --out DIR --seconds 500

FILE has one training a line: a recipe and its flags, such as `scene-experts --seed 1 --iterations 15000`; `#` begins a comment. The
schedules should be the same. After most of `--seconds`, or once all are finished, the trainings end, and the newest step that all have
saved is scored by `eval`. DIR/scores.json has the means, DIR/scores.zip the scores of each view and two pictures of each training. Times
are not compared: the trainings share the machine.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shlex
import subprocess
import sys
import time
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

SCORING = 60.0  # seconds of a slice for the scores
GRACE = 20.0  # seconds for a training that was asked to stop
PICTURES = 2  # of each training


@dataclass
class Training:
    """One line of the file, in its own folder."""

    words: list[str]
    folder: Path
    process: Any = None

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def checkpoints(self) -> Path:
        return self.folder / "checkpoints"

    @property
    def kept(self) -> Path:
        """Second names of all checkpoints: a training keeps its newest two only."""
        return self.folder.parent / "kept" / self.name

    def keep(self) -> None:
        self.kept.mkdir(parents=True, exist_ok=True)
        for path in self.checkpoints.glob("ckpt_*.safetensors"):
            if not (self.kept / path.name).exists():
                os.link(path, self.kept / path.name)


def read_trainings(path: Path, out: Path) -> list[Training]:
    """Raises SystemExit if the file has no training, or one twice."""
    lines = [line.partition("#")[0].strip() for line in path.read_text().splitlines()]
    found = [Training(shlex.split(line), out / re.sub(r"[^\w.]+", "-", line).strip("-")) for line in lines if line]
    if not found or len({training.name for training in found}) < len(found):
        raise SystemExit(f"expected one training a line in {path}, each once, found {len(found)} lines; for example: scaffold-gs --seed 0")
    return found


def find_common(trainings: list[Training]) -> str | None:
    """The name of the newest checkpoint that all trainings have, or None."""
    common = set.intersection(*({path.name for path in training.kept.glob("ckpt_*")} for training in trainings))
    return max(common, key=lambda name: int(re.sub(r"\D", "", name)), default=None)


def start(training: Training, args: argparse.Namespace) -> None:
    words = ["train", *training.words, "--data", str(args.data), "--out", str(training.folder), "--save-every", str(args.save_every)]
    words += ["--device", args.device, "--overwrite"]
    log = (training.folder.parent / f"{training.name}.txt").open("w")
    training.process = subprocess.Popen([sys.executable, "-m", "scene_experts", *words], stdout=log, stderr=subprocess.STDOUT)


def train(trainings: list[Training], args: argparse.Namespace, deadline: float) -> None:
    """Train all until the deadline, or until all have ended."""
    for training in trainings:
        start(training, args)
    try:
        while time.monotonic() < deadline and any(training.process.poll() is None for training in trainings):
            for training in trainings:
                training.keep()
            time.sleep(0.5)
    finally:
        for training in trainings:
            if training.process.poll() is None:
                training.process.terminate()
        for training in trainings:
            try:
                training.process.wait(GRACE)
            except subprocess.TimeoutExpired:
                training.process.kill()
            training.keep()


def score(trainings: list[Training], name: str, args: argparse.Namespace) -> dict[str, Any]:
    """Score one checkpoint of every training; the results by name of the training."""
    step, running = int(re.sub(r"\D", "", name)), []
    for training in trainings:
        place = training.checkpoints / name
        if not place.exists():
            os.link(training.kept / name, place)
        words = ["eval", str(training.folder), "--step", str(step), "--no-lpips", "--device", args.device]
        log = (training.folder.parent / f"{training.name}-eval.txt").open("w")
        running.append(subprocess.Popen([sys.executable, "-m", "scene_experts", *words], stdout=log, stderr=subprocess.STDOUT))
    scores: dict[str, Any] = {}
    for training, process in zip(trainings, running):
        process.wait()
        path = training.folder / "results.json"
        found = json.loads(path.read_text()) if process.returncode == 0 and path.is_file() else {}
        scores[training.name] = {"step": step} | {key: found[key] for key in ("psnr", "ssim", "anchors", "gaussians") if key in found}
    return scores


def pack(trainings: list[Training], path: Path) -> None:
    """Write the scores of each view and some pictures, as a file that is small enough to travel."""
    with zipfile.ZipFile(path, "w") as archive:
        for training in trainings:
            pictures = sorted((training.folder / "test" / "renders").glob("*"))
            chosen = pictures[:: max(1, -(-len(pictures) // PICTURES))][:PICTURES]
            for file in (training.folder / "per_view.json", *chosen):
                if file.is_file():
                    archive.write(file, f"{training.name}/{file.name}")


def show_end(path: Path) -> None:
    """Print the last lines of a command that failed."""
    print(f"{path.name}:\n" + "\n".join(path.read_text().splitlines()[-8:]))


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="a capture")
    parser.add_argument("--trainings", type=Path, required=True, help="one training a line")
    parser.add_argument("--out", type=Path, required=True, help="folder of the runs and of the scores")
    parser.add_argument("--seconds", type=float, default=500.0, help="for trainings and scores")
    parser.add_argument("--save-every", type=int, default=500, help="iterations between steps that can be scored")
    parser.add_argument("--device", default="cuda", choices=("cuda", "cpu"))
    args = parser.parse_args(argv)
    deadline = time.monotonic() + args.seconds - min(SCORING + GRACE, args.seconds / 2)
    trainings = read_trainings(args.trainings, args.out)
    args.out.mkdir(parents=True, exist_ok=True)
    train(trainings, args, deadline)
    name = find_common(trainings)
    if name is None:
        for training in trainings:
            show_end(args.out / f"{training.name}.txt")
        print("no step was saved by all trainings: give more --seconds, fewer trainings or a smaller --save-every")
        return 1
    scores = score(trainings, name, args)
    (args.out / "scores.json").write_text(json.dumps(scores, indent=1))
    pack(trainings, args.out / "scores.zip")
    failed = 0
    for training in trainings:
        found = scores[training.name]
        if "psnr" in found:
            print(f"{training.name:60} step {found['step']:6}  PSNR {found['psnr']:.3f}  SSIM {found['ssim']:.4f}")
        else:
            show_end(args.out / f"{training.name}-eval.txt")
            failed += 1
    return int(failed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
