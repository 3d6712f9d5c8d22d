"""Makes the runs of a plan: skips what is done, resumes what is not, several at a time; one failure does not lose the rest."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from scene_experts.core.checkpoint import latest
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.signals import PARENT
from scene_experts.native import library as native
from scene_experts.reproduce import store
from scene_experts.reproduce.plan import Spec
from scene_experts.training.run_folder import held

Say = Callable[[str], None]


@dataclass(frozen=True)
class Failure:
    """A run that did not end well."""

    spec: Spec
    why: str  # the last line it said
    log: Path


@dataclass
class Runner:
    """Runs specs in processes of their own."""

    runs: Path  # run folders
    records: Path  # where records are kept
    workers: int = 1
    devices: Sequence[str] = ()  # CUDA devices to share out, by index; none: the CPU, or the first device
    discard: bool = False  # remove a run folder once its record is written
    say: Say = print
    after: Callable[[Spec, Path], None] = lambda spec, folder: None  # what else to take from a run folder before it may go
    stop: threading.Event = field(default_factory=threading.Event)
    _running: set[subprocess.Popen[str]] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def make(self, specs: Sequence[Spec]) -> list[Failure]:
        """Make every run that has no record yet; returns those that failed."""
        done = store.load(self.records)
        todo = [spec for spec in specs if store.find(done, spec) is None]
        self.say(f"{len(specs)} runs, {len(specs) - len(todo)} of them done")
        free = list(range(self.workers))
        failures: list[Failure] = []

        def one(numbered: tuple[int, Spec]) -> None:
            number, spec = numbered
            if self.stop.is_set():
                return
            with self._lock:
                slot = free.pop()
            try:
                failure = self.one(spec, slot, f"[{number + 1}/{len(todo)}]")
            finally:
                with self._lock:
                    free.append(slot)
            if failure:
                failures.append(failure)

        with ThreadPoolExecutor(self.workers) as pool:
            list(pool.map(one, enumerate(todo)))
        return failures

    def one(self, spec: Spec, slot: int, place: str) -> Failure | None:
        """Train, evaluate and record one run."""
        folder = spec.folder(self.runs)
        log = folder.parent / f"{folder.name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        began = time.monotonic()
        self.say(f"{place} {spec.label}")
        train = spec.arguments(folder)
        if folder.exists():
            try:
                with held(folder):
                    if latest(folder / "checkpoints") is None:
                        shutil.rmtree(folder)  # it never came to a whole checkpoint
                    else:
                        train.append("--resume")
            except InputError:
                why = f"expected {folder} for this training alone, found one at work there; once it has ended, give the same command again"
                return self.failed(spec, why, log, place)
        for args in (train, ["eval", str(folder)]):
            code = self.command(args, slot, log)
            if self.stop.is_set():
                return None  # the next time goes on from here
            if code != 0:
                return self.failed(spec, last_line(log) or f"exit code {code}", log, place)
        try:
            record = store.of_run(folder, spec.scene.name)
            store.write(self.records, record)
            self.say(f"{place} {spec.label}: {record.results['psnr']:.2f} dB, {(time.monotonic() - began) / 60:.1f} min")
            self.after(spec, folder)
        except (InputError, RunError, OSError) as error:
            return self.failed(spec, str(error), log, place)
        if self.discard:
            shutil.rmtree(folder, ignore_errors=True)
        return None

    def failed(self, spec: Spec, why: str, log: Path, place: str) -> Failure:
        self.say(f"{place} {spec.label}: FAILED: {why}")
        return Failure(spec, why, log)

    def command(self, args: list[str], slot: int, log: Path) -> int:
        """Run `scene-experts ARGS` with the worker's share of the machine, its words going to the log; returns the exit code."""
        environment = {**os.environ, PARENT: str(os.getpid())}
        if self.workers > 1:
            environment["OMP_NUM_THREADS"] = str(max(1, native.count_cores() // self.workers))
        if self.devices:
            environment["CUDA_VISIBLE_DEVICES"] = self.devices[slot % len(self.devices)]
        with log.open("a") as stream:
            stream.write(f"$ scene-experts {' '.join(args)}\n")
            stream.flush()
            # In a process group of its own: a terminal's Ctrl-C would reach it beside our own signal, and a second signal does not save.
            process = subprocess.Popen(
                [sys.executable, "-m", "scene_experts", *args],
                stdout=stream,
                stderr=subprocess.STDOUT,
                env=environment,
                text=True,
                process_group=0,
            )
            with self._lock:
                self._running.add(process)
                if self.stop.is_set():  # `end` came while it was being started and did not see it
                    process.send_signal(signal.SIGTERM)
            try:
                return process.wait()
            finally:
                with self._lock:
                    self._running.discard(process)

    def end(self) -> None:
        """Stop: running trainings save and end; nothing new begins."""
        self.stop.set()
        with self._lock:
            for process in self._running:
                process.send_signal(signal.SIGTERM)


def last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()] if log.is_file() else []
    return lines[-1] if lines else ""
