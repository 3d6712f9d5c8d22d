"""Train the runs of an experiment, several at a time: skip those that are done, resume those that
stopped, go on after a failure."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import torch

from scene_experts.core.checkpoint import latest
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import locked
from scene_experts.core.signals import PARENT
from scene_experts.native import library as native
from scene_experts.reproduce import store
from scene_experts.reproduce.plan import Spec
from scene_experts.training.run_folder import held

Say = Callable[[str], None]
VISIBLE = "CUDA_VISIBLE_DEVICES"


@dataclass(frozen=True)
class Failure:
    """A run that failed. `why` is the reason or the last line of its log."""

    spec: Spec
    why: str
    log: Path


@dataclass
class Runner:
    """Trains each run in its own process."""

    runs: Path
    """Folder of the run folders."""
    records: Path
    """Folder of the records."""
    workers: int = 1
    """Runs at a time."""
    devices: Sequence[str] = ()
    """Indices of the CUDA devices to share among the workers, among those of CUDA_VISIBLE_DEVICES.
    Empty: the CPU, or the first device."""
    discard: bool = False
    """Remove a run folder once its record is written."""
    say: Say = print
    after: Callable[[Spec, Path], None] = lambda spec, folder: None
    """Called with each finished run folder before it may be removed."""
    threads: int = 0
    """Threads of each run. 0: the cores shared among the workers."""
    patience: float = 0.0
    """Seconds to wait for a run that another command or training holds."""
    stop: threading.Event = field(default_factory=threading.Event)
    _running: set[subprocess.Popen[str]] = field(default_factory=set)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def run_all(self, specs: Sequence[Spec]) -> list[Failure]:
        """Train every run that has no record yet; return the failures."""
        done = store.load(self.records)
        todo = [spec for spec in specs if store.find(done, spec) is None]
        self.say(f"{len(specs)} runs, {len(specs) - len(todo)} of them done")
        if todo and self.workers > 1:
            build_kernels()
        free = list(range(self.workers))
        failures: list[Failure] = []

        def work(numbered: tuple[int, Spec]) -> None:
            number, spec = numbered
            if self.stop.is_set():
                return
            with self._lock:
                slot = free.pop()
            try:
                failure = self.run(spec, slot, f"[{number + 1}/{len(todo)}]")
            finally:
                with self._lock:
                    free.append(slot)
            if failure:
                failures.append(failure)

        with ThreadPoolExecutor(self.workers) as pool:
            list(pool.map(work, enumerate(todo)))
        return failures

    def run(self, spec: Spec, slot: int, place: str) -> Failure | None:
        """Train, evaluate and record one run, unless another command did or does it. `slot` is the
        number of its worker, `place` its number among all runs as text."""
        folder = spec.folder(self.runs)
        log = folder.parent / f"{folder.name}.log"
        log.parent.mkdir(parents=True, exist_ok=True)
        why = f"expected no other command at {folder}, found one at work; repeat the command when it has ended"
        with ExitStack() as mine:
            try:
                mine.enter_context(self._patient(lambda: locked(folder.with_name(f"{folder.name}.lock"), why)))
            except InputError as error:
                return self.fail(spec, str(error), log, place)
            if store.find(store.load_like(self.records, spec), spec) is not None:
                self.say(f"{place} {spec.label}: done by another command")
                return None
            return self._run(spec, slot, place, folder, log)

    def _run(self, spec: Spec, slot: int, place: str, folder: Path, log: Path) -> Failure | None:
        began = time.monotonic()
        self.say(f"{place} {spec.label} (log: {log})")
        train = spec.arguments(folder)
        if folder.exists():
            try:
                with self._patient(lambda: held(folder)):
                    if latest(folder / "checkpoints") is None:
                        shutil.rmtree(folder)  # it stopped before its first checkpoint
                    else:
                        train.append("--resume")
            except InputError:
                why = f"expected no other training in {folder}, found a running one; repeat the command when it has ended"
                return self.fail(spec, why, log, place)
        for args in (train, ["eval", str(folder)]):
            code = self.call(args, slot, log)
            if self.stop.is_set():
                return None  # the same command resumes it
            if code != 0:
                return self.fail(spec, reason(code, log), log, place)
        try:
            record = store.read_run(folder, spec.scene.name, spec.code)
            store.write(self.records, record)
            self.say(f"{place} {spec.label}: {record.results['psnr']:.2f} dB, {(time.monotonic() - began) / 60:.1f} min")
            self.after(spec, folder)
        except (InputError, RunError, OSError) as error:
            return self.fail(spec, str(error), log, place)
        if self.discard:
            shutil.rmtree(folder, ignore_errors=True)
        return None

    @contextmanager
    def _patient(self, lock: Callable[[], AbstractContextManager[None]]) -> Iterator[None]:
        """Hold a lock, for which it waits up to `patience` seconds. Raises InputError if another
        process still holds it."""
        until = time.monotonic() + self.patience
        with ExitStack() as stack:
            while True:
                try:
                    stack.enter_context(lock())
                    break
                except InputError:
                    if time.monotonic() >= until or self.stop.wait(1.0):
                        raise
            yield

    def fail(self, spec: Spec, why: str, log: Path, place: str) -> Failure:
        self.say(f"{place} {spec.label}: FAILED: {why}")
        return Failure(spec, why, log)

    def call(self, args: list[str], slot: int, log: Path) -> int:
        """Run `scene-experts ARGS` with the worker's share of the cores, append its output to the
        log, return the exit code."""
        environment = {**os.environ, PARENT: str(os.getpid())}
        if self.threads or self.workers > 1:
            environment["OMP_NUM_THREADS"] = str(self.threads or max(1, native.count_cores() // self.workers))
        if self.devices:
            environment[VISIBLE] = visible_device(self.devices[slot % len(self.devices)], os.environ.get(VISIBLE))
        with log.open("a") as stream:
            stream.write(f"$ scene-experts {' '.join(args)}\n")
            stream.flush()
            # Its own process group: a terminal's Ctrl-C must not reach it beside our SIGTERM, as a
            # second signal ends it without saving.
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
                if self.stop.is_set():  # `end` was called while the process started
                    process.send_signal(signal.SIGTERM)
            try:
                return process.wait()
            finally:
                with self._lock:
                    self._running.discard(process)

    def end(self) -> None:
        """Stop: running trainings save and end, no other one starts."""
        self.stop.set()
        with self._lock:
            for process in self._running:
                process.send_signal(signal.SIGTERM)


def visible_device(index: str, visible: str | None) -> str:
    """Return CUDA_VISIBLE_DEVICES for a run on device `index` (--devices) of the devices that a
    scheduler gave to this process.

    visible: CUDA_VISIBLE_DEVICES of this process, or None if it is not set. With "4,5", index 1 is
    device 5.

    Raises InputError, which names --devices, if `index` is not among the visible devices.
    """
    given = [name.strip() for name in visible.split(",")] if visible is not None else None
    if given is None or not index.isdecimal():
        return index
    if int(index) >= len(given) or not given[int(index)]:
        raise InputError(
            f"expected --devices within the {len([g for g in given if g])} of {VISIBLE} ({visible!r}), found {index}; change it"
        )
    return given[int(index)]


def build_kernels() -> None:
    """Build the CUDA code of gsplat in a process of its own, if this machine has a CUDA device.

    gsplat compiles itself on its first import, and removes the lock and the build folder of a build
    that another process runs. Workers that start together would therefore break each other's build.
    """
    if torch.cuda.is_available():
        code = "from scene_experts.render.gsplat_install import explain_missing; explain_missing()"
        subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, check=False)


def reason(code: int, log: Path) -> str:
    """Return why a command with the exit code `code` failed: the last line of its log, and the
    signal that has ended it, if one has."""
    said = last_line(log)
    if code >= 0:
        return said or f"exit code {code}"
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    memory = " (often for too little memory)" if name == "SIGKILL" else ""
    return f"the process was ended by {name}{memory}; repeat the command to continue. Its last line: {said or 'none'}"


def last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()] if log.is_file() else []
    return lines[-1] if lines else ""
