"""Train the runs of an experiment on the workers of a Dask cluster (`--cluster`).

Dask places the runs, and repeats a run whose worker is lost or whose training failed. All machines
share the run folders, so a repeated run continues from its last checkpoint.
"""

from __future__ import annotations

import pickle
import shutil
import threading
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from filelock import FileLock

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.version import __version__
from scene_experts.reproduce import store
from scene_experts.reproduce.plan import Spec
from scene_experts.reproduce.runner import Failure, Runner, build_kernels

if TYPE_CHECKING:
    from distributed import Client, Future

CONNECT = 10.0  # seconds that the scheduler has to answer
RETRIES = 1  # of a run that fails; Dask's own setting `allowed-failures` limits how many workers a run may lose
PATIENCE = 120.0  # seconds that a repeated run waits for the training of a lost worker to save and end


@dataclass(frozen=True)
class PlacedRun:
    """One run, as a worker gets it. All paths are absolute."""

    spec: Spec
    runs: Path
    records: Path
    token: str
    """Name of a file in `runs` and in `records` that exists while the command works. A worker that
    does not find it has other folders."""
    place: str
    resources: dict[str, float]


@dataclass
class ClusterRunner(Runner):
    """Trains each run on a worker of a Dask cluster. Records, pictures and the removal of run
    folders are as in `Runner`."""

    address: str = ""
    """Address of the scheduler."""
    resources: dict[str, float] = field(default_factory=dict)
    """What each run takes from its worker. Empty: one of its threads."""
    _tokens: list[Path] = field(default_factory=list)

    def run_all(self, specs: Sequence[Spec]) -> list[Failure]:
        """Train every run that has no record yet; return the failures.

        Raises InputError if the scheduler does not answer, or if a worker has no such package,
        another version of it, or other folders.
        """
        done = store.load(self.records)
        todo = [spec for spec in specs if store.find(done, spec) is None]
        self.say(f"{len(specs)} runs, {len(specs) - len(todo)} of them done")
        if not todo:
            return []
        with connect(self.address) as client, self._token() as token:
            found = client.scheduler_info(n_workers=-1)["workers"]
            self.say(f"{len(found)} workers at {self.address}" + ("" if found else "; waiting for the first"))
            return self._gather(client, self._submit(client, todo, token))

    def _submit(self, client: Client, todo: Sequence[Spec], token: str) -> dict[Future, Spec]:
        task, futures = make_task(), {}
        for number, spec in enumerate(todo):
            there = replace(spec, scene=replace(spec.scene, path=spec.scene.path.absolute()))
            job = PlacedRun(there, self.runs, self.records, token, f"[{number + 1}/{len(todo)}]", self.resources)
            future = client.submit(
                task,
                __version__,
                pickle.dumps(job),
                key=f"scene-experts-{spec.key}-{token[1:]}",
                resources=self.resources or None,
                retries=RETRIES,
                priority=-number,
            )
            futures[future] = spec
        return futures

    def _gather(self, client: Client, futures: dict[Future, Spec]) -> list[Failure]:
        """Wait for the runs and return the failures. After `end`, wait only for those that run now:
        they save and end."""
        failures, pending = [], set(futures)
        while pending:
            time.sleep(0.2)
            ended = {future for future in pending if future.done()}
            for future in ended:
                failure = self._finish(future, futures[future])
                failures += [failure] if failure else []
            pending -= ended
            if self.stop.is_set():
                running = {key for keys in cast(dict[str, list[str]], client.processing()).values() for key in keys}
                pending = {future for future in pending if future.key in running}
        return failures

    def _finish(self, future: Future, spec: Spec) -> Failure | None:
        folder = spec.folder(self.runs)
        log = folder.parent / f"{folder.name}.log"
        if self.stop.is_set():
            return None  # the same command continues it
        if future.status != "finished":
            return self._lost(future, spec, log)
        kind, text = future.result()
        if kind == "input":
            raise InputError(text)
        self.say(text)
        try:
            self.after(spec, folder)
        except (InputError, RunError, OSError) as error:
            return self.fail(spec, str(error), log, spec.label)
        if self.discard:
            shutil.rmtree(folder, ignore_errors=True)
        return None

    def _lost(self, future: Future, spec: Spec, log: Path) -> Failure:
        from distributed import KilledWorker

        error = future.exception() if future.status == "error" else None
        if isinstance(error, KilledWorker):
            why = "expected a worker that lives until the run ends, found that every worker that tried was lost; see the workers' logs"
        else:
            why = str(error) if error else f"expected the scheduler to keep the run, found it {future.status}; repeat the command"
        self.say(f"{spec.label}: FAILED: {why}")
        return Failure(spec, why, log)

    @contextmanager
    def _token(self) -> Iterator[str]:
        token = f".cluster-{uuid.uuid4().hex[:12]}"
        self._tokens = [folder / token for folder in (self.runs, self.records)]
        for path in self._tokens:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
        try:
            yield token
        finally:
            self._remove_tokens()

    def _remove_tokens(self) -> None:
        for path in self._tokens:
            path.unlink(missing_ok=True)

    def end(self) -> None:
        """Stop: running trainings save and end, no other one starts."""
        super().end()
        self._remove_tokens()


@contextmanager
def connect(address: str) -> Iterator[Client]:
    """Connect to the scheduler at `address`. Raises InputError if `distributed` is not installed or
    if no scheduler answers."""
    try:
        from distributed import Client
    except ImportError as error:
        raise InputError(f"expected the package distributed for --cluster, found none; {install_line('cluster')}") from error

    class Closing(Client):
        """A client that is closed at once if it cannot connect.

        Dask leaves it to the garbage collector, which may close it while this thread starts another
        client and holds the lock that closing takes: the program then waits for ever.
        """

        def __init__(self) -> None:
            try:
                super().__init__(address, timeout=CONNECT, set_as_default=False)
            except BaseException:
                self.close()
                raise

    try:
        client = Closing()
    except (OSError, TimeoutError, ValueError, TypeError) as error:
        why = f"expected a Dask scheduler at --cluster {address}, found none that answers; start one with `dask scheduler`"
        raise InputError(f"{why}, or correct the address") from error
    with client:
        yield client


def make_task() -> Callable[[str, bytes], tuple[str, str]]:
    """Return the function that a worker calls.

    It is a nested function without names of this package, so Dask sends its code. A worker without
    this package can therefore say so.
    """

    def task(version: str, job: bytes) -> tuple[str, str]:
        from distributed import get_worker

        where = get_worker().address
        try:
            from scene_experts.core.version import __version__ as found
            from scene_experts.reproduce.cluster import work
        except ImportError as error:
            return "input", f"expected scene-experts {version} on the worker {where}, found none ({error}); install it there"
        if found != version:
            return "input", f"expected scene-experts {version} on the worker {where}, found version {found}; install the same version there"
        return work(job)

    return task


def work(packed: bytes) -> tuple[str, str]:
    """Train, evaluate and record one run on this worker.

    packed: a pickled `PlacedRun`, from the same version of this package.

    Returns ("done", one line about the run), or ("input", a sentence) if this machine does not see
    the folders of the command.

    Raises RuntimeError with the reason if the run fails, so that Dask repeats it.
    """
    from distributed import get_worker

    worker = get_worker()
    job: PlacedRun = pickle.loads(packed)
    capture = job.spec.scene.path
    shared = [(job.runs, job.runs / job.token, "--out"), (job.records, job.records / job.token, "--records")]
    for folder, file, flag in [*shared, (capture, capture, "--captures or --data")]:
        if not file.exists():
            why = f"expected the folder {folder} on the worker {worker.address}, found another one or none"
            return "input", f"{why}; give {flag} in a folder that all machines share"
    if store.find(store.load_like(job.records, job.spec), job.spec) is not None:
        return "done", f"{job.place} {job.spec.label}: done before"
    with FileLock(job.runs / ".kernels.lock"):
        build_kernels()
    lines: list[str] = []
    state = worker.state
    runner = Runner(job.runs, job.records, say=lines.append, threads=threads(state.nthreads, state.total_resources, job.resources))
    runner.patience = PATIENCE
    with stopping_without(job.runs / job.token, runner):
        failure = runner.run(job.spec, 0, job.place)
    if failure:
        raise RuntimeError(failure.why)
    return "done", lines[-1] + f", {worker.address}"


def threads(nthreads: int, total: dict[str, Any], wanted: dict[str, float]) -> int:
    """Return the threads of a run: those of its worker, shared among the runs that the worker can
    hold at a time."""
    at_once = min([nthreads, *(int(total.get(name, 0) // amount) for name, amount in wanted.items())])
    return max(1, nthreads // max(1, at_once))


@contextmanager
def stopping_without(token: Path, runner: Runner) -> Iterator[None]:
    """Call `runner.end` once `token` does not exist any more."""
    over = threading.Event()

    def watch() -> None:
        while not over.wait(1.0):
            if not token.exists():
                return runner.end()

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        watcher.join()
