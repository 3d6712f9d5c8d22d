"""Kill trainings at random moments, resume them, and compare the end with a training that was left alone.

Each training is a fork of this process, which has run every recipe once, so that a kill takes a tenth of a second. Half of the kills
wait for a checkpoint that is being written.
"""

from __future__ import annotations

import io
import json
import os
import random
import shutil
import signal
import time
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path

import torch

from scene_experts import cli
from scene_experts.core import checkpoint
from support.trainings import assert_same

FAMILIES = ("moe-gs", "scaffold-gs", "octree-moe-gs", "sags", "3dgs", "3dgs-mcmc")
END = 40  # iterations of a training
LATEST = 0.4  # seconds of the processor until a kill at a random moment


@dataclass
class Crashes:
    """Kills trainings of `capture` in `folder` and counts what happened."""

    capture: Path
    folder: Path
    seed: int = 0
    count: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.rng = random.Random(self.seed)

    def arguments(self, recipe: str, out: Path, end: int = END) -> list[str]:
        """Return the command line of a training that saves after every iteration, or of its continuation if it has begun in `out`."""
        args = ["train", recipe, "--data", str(self.capture), "--out", str(out), "--iterations", "600", "--stop-at", str(end)]
        args += ["--growth.adjust.interval", "20", "--save-every", "1", "--preview-every", "0", "--deterministic", "--device", "cpu"]
        return [*args, "--resume"] if (out / "config.json").exists() else args

    def warm_up(self, families: tuple[str, ...]) -> None:
        """Train two iterations of each recipe in this process, which loads the code that the forks then need not load."""
        for recipe in families:
            out = self.folder / f"{recipe}-warm"
            with redirect_stdout(io.StringIO()), redirect_stderr(io.StringIO()) as messages:
                done = [cli.main(self.arguments(recipe, out, end)) for end in (1, 2)]
            assert done == [0, 0], messages.getvalue()
            shutil.rmtree(out)

    def start(self, recipe: str, out: Path) -> int:
        """Start or resume a training in a fork and return its process id."""
        args = self.arguments(recipe, out)
        if pid := os.fork():
            return pid
        try:
            log = os.open(self.folder / "log.txt", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(log, 1)
            os.dup2(log, 2)
            os._exit(cli.main(args))
        finally:
            os._exit(70)

    def finish(self, recipe: str, out: Path) -> None:
        """Run a training to its end. Raises AssertionError with its messages if it fails."""
        _, status = os.waitpid(self.start(recipe, out), 0)
        assert os.waitstatus_to_exitcode(status) == 0, (self.folder / "log.txt").read_text()

    def kill(self, recipe: str) -> None:
        """Start or resume the training of a recipe and kill it; where it ended before, compare it and begin another."""
        out = self.folder / recipe
        before = self.reached(out)
        pid = self.start(recipe, out)
        saving, moment = self.rng.random() < 0.5, self.rng.uniform(0.0, LATEST)
        while True:
            done, status = os.waitpid(pid, os.WNOHANG)
            if done:
                assert os.waitstatus_to_exitcode(status) == 0, (self.folder / "log.txt").read_text()
                self.compare(recipe)
                self.count["ended before"] += 1
                return
            if _seconds(pid) > moment and (not saving or _writes(out)):
                break
            time.sleep(0.0005)
        os.kill(pid, signal.SIGKILL)
        os.waitpid(pid, 0)
        self.count["kills"] += 1
        self.count["during a save"] += bool(_writes(out))
        after = self.reached(out)
        assert after >= before, f"{recipe}: iteration {before} was saved, {after} is left"

    def reached(self, out: Path) -> int:
        """Return the iteration of the newest intact checkpoint, 0 without any. Every file that has a checkpoint's name must be intact."""
        files = sorted((out / "checkpoints").glob("ckpt_*.safetensors"))
        steps = [checkpoint.load(file)[1]["step"] for file in files]  # raises for a damaged one
        return max(steps, default=0)

    def compare(self, recipe: str) -> None:
        """Compare a finished training with the one that was left alone, bit for bit, and remove it."""
        alone, out = self.folder / f"{recipe}-alone", self.folder / recipe
        if not alone.exists():
            self.finish(recipe, alone)
        assert_same(_tensors(out), _tensors(alone))
        other = [(a, b) for a, b in zip_longest(_metrics(out), _metrics(alone)) if a != b]
        assert not other, f"{recipe}: metrics differ in {len(other)} lines, first {other[0]}"
        names = [sorted(p.relative_to(run) for p in (run / "point_cloud").rglob("*")) for run in (out, alone)]
        assert names[0] == names[1], f"{recipe}: other exported files"
        left = list(out.rglob("*.part"))
        assert not left, f"{recipe}: {left} are left"
        self.count["compared"] += 1
        shutil.rmtree(out)

    def run(self, rounds: int, families: tuple[str, ...] = FAMILIES) -> Counter[str]:
        """Kill `rounds` times, one family after the other, then finish and compare every training."""
        self.warm_up(families)
        for number in range(rounds):
            self.kill(families[number % len(families)])
        for recipe in families:
            if (self.folder / recipe).exists():
                self.finish(recipe, self.folder / recipe)
                self.compare(recipe)
        return self.count


def _writes(out: Path) -> list[Path]:
    """Return the checkpoints that are being written."""
    return list((out / "checkpoints").glob(".ckpt_*.part"))


def _seconds(pid: int) -> float:
    """Return the seconds of the processor that a child has used: on a busy machine it comes as far as on an idle one."""
    return int(Path(f"/proc/{pid}/schedstat").read_text().split()[0]) / 1e9


def _metrics(out: Path) -> list[dict[str, object]]:
    lines = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    return [{name: value for name, value in line.items() if name != "seconds"} for line in lines]


def _tensors(out: Path) -> dict[str, torch.Tensor]:
    path = checkpoint.latest(out / "checkpoints")
    assert path is not None
    return checkpoint.load(path)[0]
