"""Tensors that say they are on `cuda:0` and hold a tensor on the CPU. Importing this module changes torch in the whole process.

`Pretending` is the context in which tensors made for a CUDA device pretend. `counts` adds up what a GPU would do: kernels, bytes that they
read and write, copies from the host that block it, and waits of the host for the device.
"""

from __future__ import annotations

import collections
import sys
import time
from collections.abc import Callable
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

CUDA = torch.device("cuda", 0)
VIEWS = {
    *(
        "view",
        "_unsafe_view",
        "expand",
        "t",
        "transpose",
        "permute",
        "slice",
        "select",
        "unsqueeze",
        "squeeze",
        "detach",
        "alias",
        "diagonal",
    ),
    *("as_strided", "unbind", "split", "split_with_sizes", "_reshape_alias", "chunk", "movedim", "lift_fresh", "unfold", "is_pinned"),
    *("empty", "empty_like", "new_empty", "new_empty_strided", "empty_strided", "sym_size", "_local_scalar_dense"),
}
WAITS = {
    *("_local_scalar_dense", "nonzero", "item", "unique_dim", "_unique2", "unique_consecutive", "equal", "is_nonzero", "masked_select"),
    *("bincount", "repeat_interleave"),
}
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_"}


class Counts:
    """What was counted since the last `reset`, and at which lines of the package."""

    def __init__(self) -> None:
        self.quiet = 0
        self.reset()

    def reset(self) -> None:
        self.kernels: collections.Counter[str] = collections.Counter()
        self.waits: collections.Counter[str] = collections.Counter()
        self.blocking: collections.Counter[str] = collections.Counter()
        self.where: collections.Counter[str] = collections.Counter()
        self.moved: collections.Counter[str] = collections.Counter()

    def kernel(self, name: str, moved: int) -> None:
        if not self.quiet:
            self.kernels[name] += 1
            line = find_line()
            self.where[line] += 1
            self.moved[f"{name} {line}"] += moved

    @property
    def bytes(self) -> int:
        """Bytes that all kernels read and write."""
        return sum(self.moved.values())

    def wait(self, name: str) -> None:
        if not self.quiet:
            self.waits[f"{name} {find_line()}"] += 1

    def block(self, name: str) -> None:
        if not self.quiet:
            self.blocking[f"{name} {find_line()}"] += 1

    def __enter__(self) -> None:
        self.quiet += 1

    def __exit__(self, *reason: object) -> None:
        self.quiet -= 1


counts = Counts()
"""The counts of this process. `with counts:` counts nothing."""


def find_line() -> str:
    """Return the innermost line of the package or of torch's optimisers that runs, else "autograd"."""
    frame, best = sys._getframe(2), None
    while frame is not None:
        name = frame.f_code.co_filename
        if "/scene_experts/" in name:
            return f"{name.split('/scene_experts/')[-1]}:{frame.f_lineno}"
        if best is None and "/torch/optim/" in name:
            best = f"{name.split('site-packages/')[-1]}:{frame.f_lineno}"
        frame = frame.f_back
    return best or "autograd"


class Pretender(torch.Tensor):
    """A tensor on `cuda:0` that holds `inner` on the CPU."""

    inner: torch.Tensor

    @staticmethod
    def __new__(cls, inner: torch.Tensor):
        sizes = {"strides": inner.stride(), "storage_offset": inner.storage_offset(), "dtype": inner.dtype, "layout": inner.layout}
        made = torch.Tensor._make_wrapper_subclass(cls, inner.size(), device=CUDA, requires_grad=False, **sizes)
        made.inner = inner
        return made

    def __repr__(self) -> str:
        return f"Pretender({self.inner!r})"

    def tolist(self):
        counts.wait("tolist")
        return self.inner.tolist()

    def data_ptr(self) -> int:
        return self.inner.data_ptr()

    def new_tensor(self, data, **options):
        counts.block("new_tensor")
        return Pretender(self.inner.new_tensor(data, **options))

    def numpy(self, *args, **options):
        raise TypeError("can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor to host memory first.")

    __array__ = numpy

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return call(func, args, kwargs or {})


class Pretending(TorchDispatchMode):
    """Context in which tensors made for a CUDA device pretend to be there."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # nothing is compiled here, and the wrapper of each call costs as much as the call

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return call(func, args, kwargs or {})


def find_tensors(values: Any, into: list[torch.Tensor]) -> list[torch.Tensor]:
    """Append the tensors in nested sequences to `into`."""
    for value in values:
        if isinstance(value, torch.Tensor):
            into.append(value)
        elif isinstance(value, (list, tuple)):
            find_tensors(value, into)
    return into


def replace_tensors(value: Any, change: Callable[[torch.Tensor], torch.Tensor]) -> Any:
    """Return `value` with the tensors in nested sequences changed."""
    if isinstance(value, torch.Tensor):
        return change(value)
    return type(value)(replace_tensors(v, change) for v in value) if isinstance(value, (list, tuple)) else value


def unwrap(value: torch.Tensor) -> torch.Tensor:
    return value.inner if isinstance(value, Pretender) else value


def call(func: Any, args: Any, kwargs: Any) -> Any:
    """Run one operation of torch on the tensors inside, after the checks and counts of a GPU. No mode is active here."""
    name = func.overloadpacket.__name__
    if name == "is_pinned":
        return False
    tensors = find_tensors(kwargs.values(), find_tensors(args, []))
    ours, others = [t for t in tensors if isinstance(t, Pretender)], [t for t in tensors if not isinstance(t, Pretender)]
    device = kwargs.get("device")
    on_cuda = bool(ours) if device is None else torch.device(device).type == "cuda"
    if device is not None and on_cuda:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    copying = name in ("_to_copy", "copy_")
    if ours and others and not copying:
        check_devices(name, func, args, tensors, others)
    if copying:
        count_copy(name, args, kwargs, device, on_cuda)
    if ours:
        args, kwargs = replace_tensors(args, unwrap), {key: replace_tensors(value, unwrap) for key, value in kwargs.items()}
    if kwargs.get("pin_memory"):
        kwargs = {**kwargs, "pin_memory": False}
    out = func(*args, **kwargs)
    if not on_cuda:
        return out
    by_mask = name in INDEXING and any(t.dtype == torch.bool and t.dim() for t in tensors[1:])
    if name in WAITS or by_mask:
        counts.wait("boolean index" if by_mask else name)
    if name not in VIEWS:
        counts.kernel(name, sum(t.numel() * t.element_size() for t in (*ours, *find_tensors((out,), []))))
    known = {id(t.inner): t for t in ours}
    return replace_tensors(out, lambda t: known[id(t)] if id(t) in known else Pretender(t))


def check_devices(name: str, func: Any, args: Any, tensors: list[torch.Tensor], others: list[torch.Tensor]) -> None:
    """Raise RuntimeError if tensors on the CPU reach an operation on CUDA. CUDA takes single numbers, and moves indices itself."""
    wrong = [t for t in others if t.dim() > 0]
    if name in INDEXING and isinstance(args[0], Pretender):
        counts.block("indices on the CPU")
        wrong = []
    if wrong or name.startswith(("_fused_adam", "index_select", "gather", "scatter", "index_add", "index_copy", "cat", "searchsorted")):
        shapes = [(type(t).__name__, tuple(t.shape)) for t in tensors]
        raise RuntimeError(f"expected all tensors on one device, found cuda:0 and cpu in {func} {shapes} at {find_line()}")


def count_copy(name: str, args: Any, kwargs: Any, device: Any, on_cuda: bool) -> None:
    if name == "copy_":
        if isinstance(args[0], Pretender) != isinstance(args[1], Pretender) and not (len(args) > 2 and args[2]):
            counts.wait("copy_")
    elif device is not None and isinstance(args[0], Pretender) and not on_cuda:
        counts.wait("copy to the host")
    elif device is not None and not isinstance(args[0], Pretender) and on_cuda and not kwargs.get("non_blocking"):
        counts.block("copy")


_to, _tensor = torch.Tensor.to, torch.tensor


def _placed(value: Any) -> Any:
    """`cuda` without an index is `cuda:0`."""
    return CUDA if value == "cuda" or (isinstance(value, torch.device) and value.type == "cuda") else value


def to(self, *args, **kwargs):
    return _to(self, *[_placed(v) for v in args], **{n: _placed(v) for n, v in kwargs.items()})


def tensor(data, *args, device=None, **kwargs):
    made = _tensor(data, *args, **kwargs)
    if device is None or torch.device(device).type == "cpu":
        return made
    counts.block("torch.tensor")
    return Pretender(made)


class _Properties:
    multi_processor_count, name, total_memory, major, minor = 8, "pretended", 1 << 34, 9, 0


class _Device:
    def __init__(self, device: Any) -> None:
        pass

    def __enter__(self) -> None:
        pass

    def __exit__(self, *reason: object) -> None:
        pass


class _Event:
    """A moment on the clock of the host."""

    def __init__(self, enable_timing: bool = False) -> None:
        self.at = 0.0

    def record(self) -> None:
        self.at = time.perf_counter()

    def synchronize(self) -> None:
        pass

    def elapsed_time(self, later: _Event) -> float:
        return 1e3 * (later.at - self.at)


def install() -> None:
    """Change torch so that it finds one CUDA device."""
    for name, value in {
        "_lazy_init": lambda: None,
        "is_available": lambda: True,
        "memory_reserved": lambda device=None: 0,
        "max_memory_allocated": lambda device=None: 0,
        "mem_get_info": lambda device=None: (1 << 33, 1 << 34),
        "reset_peak_memory_stats": lambda device=None: None,
        "empty_cache": lambda: None,
        "current_device": lambda: 0,
        "device_count": lambda: 1,
        "device": _Device,
        "Event": _Event,
        "get_device_name": lambda device=None: "no GPU: tensors that pretend",
        "synchronize": lambda device=None: None,
        "get_rng_state": lambda device=None: torch.get_rng_state(),
        "set_rng_state": lambda state, device=None: None,
        "get_device_capability": lambda device=None: (9, 0),
        "get_device_properties": lambda device=None: _Properties,
    }.items():
        setattr(torch.cuda, name, value)
    torch.Tensor.pin_memory = lambda self, device=None: self
    torch.Tensor.to = to
    torch.Tensor.cuda = lambda self, *args, **kwargs: to(self, CUDA)
    torch.tensor = tensor
    torch.__future__.set_overwrite_module_params_on_conversion(True)


install()
