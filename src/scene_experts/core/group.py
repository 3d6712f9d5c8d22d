"""Processes that work on one thing together: one process (`Alone`), or the processes that
`torchrun` has started (`Group`).

Both have the same methods, so that the code that uses them does not ask which one it has. Every
process must call the methods that exchange data in the same order.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import timedelta
from importlib import import_module
from typing import Any, TypeVar

import torch
import torch.distributed as dist
from torch import Tensor

from scene_experts.core.errors import InputError, RunError

T = TypeVar("T")
JOINING = timedelta(minutes=10)
TIMEOUT = timedelta(days=1)  # a lost process is noticed at once; a slow one may show a picture, save, or wait for a person


class Alone:
    """One process. Nothing is exchanged."""

    rank: int = 0
    """Number of this process, from 0."""
    local: int = 0
    """Number of this process on its machine, from 0; the number of its GPU."""
    size: int = 1
    """Number of processes."""
    restarts: int = 0
    """How often `torchrun` has restarted the processes."""
    sent: int = 0
    """Bytes of the tensors that this process has handed to `sum`, `gather` and `exchange`."""

    @property
    def first(self) -> bool:
        """Whether this is process 0, which writes all files."""
        return self.rank == 0

    def sum(self, tensor: Tensor) -> None:
        """Add up the tensors of all processes, in place. They have one shape."""

    def gather(self, tensor: Tensor) -> list[Tensor]:
        """Return the tensors of all processes in the order of their numbers. They have one
        shape."""
        return [tensor]

    def exchange(self, parts: list[Tensor]) -> list[Tensor]:
        """Send `parts[r]` [n, ...] to process r, and return what each process has sent to this one.
        Only n may differ."""
        return parts

    def gather_values(self, value: T) -> list[T]:
        """Return the Python values of all processes in the order of their numbers."""
        return [value]

    def wait(self) -> None:
        """Return when every process has called this."""
        self.gather_values(None)

    def any(self, flag: bool) -> bool:
        """Return whether the flag of any process is true."""
        return any(self.gather_values(flag))

    def smallest(self, value: int) -> int:
        """Return the smallest value of all processes."""
        return min(self.gather_values(value))

    def copy_from_first(self, tensors: list[Tensor]) -> None:
        """Overwrite the tensors with those of process 0."""

    def agree(self, work: Callable[[], T]) -> T:
        """Do `work` in every process. If it raises InputError or RunError in one of them, every
        process ends.

        The first process that works without an error of its own raises nothing but SystemExit, so
        the error is printed once.
        """
        return work()

    def in_turn(self, work: Callable[[], T]) -> T:
        """Do `work` first in one process of each machine and then in the others, for work that
        fills a cache of the machine."""
        return work()

    def leave(self) -> None:
        """End the exchange. Call it at the end of successful work."""


class Group(Alone):
    """The processes that `torchrun` has started. Create it with `join`."""

    def __init__(self, device: str) -> None:
        """Connect to the other processes. device: "cpu" (gloo) or "cuda" (nccl)."""
        self.rank, self.size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
        self.local = int(os.environ.get("LOCAL_RANK", self.rank))
        self.restarts = restarts()
        self.sent = 0
        # Parts of torch import this module later. Its functions would then keep the group as a
        # default argument, and gloo's threads
        # would go on after `leave`: they can abort the process at its end.
        import_module("torch.distributed.nn.functional")
        # Flags and Python values travel over gloo, also beside nccl: they are on the CPU.
        backends = "cpu:gloo,cuda:nccl" if device == "cuda" else "gloo"
        with self._expecting_all():
            dist.init_process_group(backends, store=self._meet(), rank=self.rank, world_size=self.size, timeout=TIMEOUT)

    def _meet(self) -> Any:
        """Return the key-value store of this start of the processes, when all of them have reached
        it.

        After a restart `torchrun` may serve the store of the processes before. Their addresses are
        still in it, and gloo would wait for them for ever. Each start has keys of its own.
        """
        from torch.distributed import PrefixStore, rendezvous  # pyright: ignore[reportPrivateImportUsage]  # documented, but not in __all__

        store, _, _ = next(rendezvous("env://", timeout=JOINING))
        store = PrefixStore(f"scene-experts/{self.restarts}/{self.size}", store)
        store.set(f"here/{self.rank}", "")
        store.wait([f"here/{rank}" for rank in range(self.size)], JOINING)
        return store

    def sum(self, tensor: Tensor) -> None:
        self.sent += tensor.numel() * tensor.element_size()
        with self._expecting_all():
            dist.all_reduce(tensor)

    def gather(self, tensor: Tensor) -> list[Tensor]:
        self.sent += tensor.numel() * tensor.element_size()
        out = [torch.empty_like(tensor) for _ in range(self.size)]
        with self._expecting_all():
            dist.all_gather(out, tensor.contiguous())
        return out

    def exchange(self, parts: list[Tensor]) -> list[Tensor]:
        counts = [len(part) for part in parts]
        incoming = [int(count[self.rank]) for count in self.gather(torch.tensor(counts, device=parts[0].device))]
        out = parts[0].new_empty(sum(incoming), *parts[0].shape[1:])
        self.sent += sum(p.numel() * p.element_size() for r, p in enumerate(parts) if r != self.rank)
        with self._expecting_all():
            dist.all_to_all_single(out, torch.cat(parts), incoming, counts)
        return list(out.split(incoming))

    def gather_values(self, value: T) -> list[T]:
        out: list[Any] = [None] * self.size
        with self._expecting_all():
            dist.all_gather_object(out, value)
        return out

    def copy_from_first(self, tensors: list[Tensor]) -> None:
        with self._expecting_all():
            for tensor in tensors:
                whole = tensor.detach().contiguous()
                dist.broadcast(whole, 0)
                tensor.detach().copy_(whole)

    def agree(self, work: Callable[[], T]) -> T:
        error: Exception | None = None
        result: Any = None
        try:
            result = work()
        except (InputError, RunError) as found:
            error = found
        errors = self.gather_values(None if error is None else (type(error), str(error)))
        first = next((number for number, found in enumerate(errors) if found), None)
        if first is None:
            return result
        self.leave()  # without it, gloo's threads may abort the process, which then has another exit code
        if first == self.rank and error is not None:
            raise error
        raise SystemExit(2 if errors[first][0] is InputError else 1)  # type: ignore[index]

    def in_turn(self, work: Callable[[], T]) -> T:
        if self.local == 0:
            result = work()
            self.wait()
            return result
        self.wait()
        return work()

    def leave(self) -> None:
        dist.destroy_process_group()

    @contextmanager
    def _expecting_all(self) -> Iterator[None]:
        """Turn an error of the connection into RunError: a process has ended, so the others cannot
        go on."""
        try:
            yield
        except RuntimeError as error:
            why = str(error).strip().partition("\n")[0][-160:]
            raise RunError(
                f"expected all {self.size} processes, found that process {self.rank} lost another ({why}); "
                "saved checkpoints are intact: start again with --resume"
            ) from None


def world_size() -> int:
    """Return the number of processes that `torchrun` has started, 1 without it. Raises InputError
    if it is not a number."""
    words = os.environ.get("WORLD_SIZE", "1")
    if "RANK" not in os.environ:
        return 1
    if not (words.isdecimal() and int(words) > 0):
        raise InputError(f"expected a number of processes in the variable WORLD_SIZE, found '{words}'; start the processes with torchrun")
    return int(words)


def restarts() -> int:
    """Return how often `torchrun` has restarted this process. 0 without it."""
    words = os.environ.get("TORCHELASTIC_RESTART_COUNT", "0")
    return int(words) if words.isdecimal() else 0


def join(device: str) -> Alone:
    """Return the group of this process: `Alone`, or the processes that `torchrun` has started.

    device: "cpu" or "cuda". With "cuda", process i of a machine uses its GPU i from now on.

    Raises:
        InputError: The machine has fewer GPUs than processes.
        RunError: The other processes cannot be reached.
    """
    if world_size() == 1:
        alone = Alone()
        alone.restarts = restarts()
        return alone
    if device == "cuda":
        local, gpus = int(os.environ.get("LOCAL_RANK", "0")), torch.cuda.device_count()
        if local >= gpus:
            raise InputError(f"expected a GPU for each process, found {gpus} for {local + 1} or more; start {gpus} on this machine")
        torch.cuda.set_device(local)
    return Group(device)
