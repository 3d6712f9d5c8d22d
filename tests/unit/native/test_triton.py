"""Whether Triton kernels can run, and on which device."""

from types import SimpleNamespace
from typing import ClassVar

import torch

from scene_experts.native import triton


def test_absent_triton_is_a_sentence(monkeypatch):
    def absent(name):
        raise ImportError(f"No module named '{name}'")

    monkeypatch.setattr(triton.importlib, "import_module", absent)
    reason = triton.explain_missing.__wrapped__()
    assert "No module named 'triton'" in reason and "pip install triton" in reason


def test_a_kernel_runs_on_the_device_of_its_tensors(monkeypatch):
    class Kernel:
        def __getitem__(self, grid):
            return lambda *arguments, **sizes: calls.append((grid, arguments[1:], sizes, list(current)))

    class Device:
        def __init__(self, device):
            self.device = device

        def __enter__(self):
            current.append(self.device)

        def __exit__(self, *reason):
            current.pop()

    calls, current = [], []
    monkeypatch.setattr(torch.cuda, "device", Device)
    triton.launch(Kernel(), (3,), torch.zeros(1), 5, B=16)
    assert calls == [((3,), (5,), {"B": 16}, [])]
    with triton.guard(torch.device("cuda", 1)):
        assert current == [torch.device("cuda", 1)]
    assert not triton.covers(torch.zeros(1)), "tensors on the CPU"


class Compiled:
    """A kernel as Triton gives it: compiles where it is called like one, and is launched by `run`."""

    arg_names = ("x", "y", "n", "B")
    device_caches: ClassVar[dict] = {}

    def __init__(self):
        self.params = [SimpleNamespace(do_not_specialize=name == "n") for name in self.arg_names]
        self.compiled, self.launched = [], []

    def __getitem__(self, grid):
        def compile(*arguments, **sizes):
            self.compiled.append((grid, arguments, sizes))
            return SimpleNamespace(run=lambda *given: self.launched.append(given), function="f", packed_metadata="m")

        return compile


def test_a_kernel_is_compiled_once_for_all_that_triton_compiles_it_for(monkeypatch):
    monkeypatch.setattr(torch.cuda, "current_device", lambda: None)
    monkeypatch.setattr(triton, "_stream_of", lambda device: 77)
    kernel, x = Compiled(), torch.zeros(40)
    y = x[4:]  # 16 bytes on
    triton.launch(kernel, (3,), x, y, 5, B=16, num_warps=4)
    triton.launch(kernel, (4, 2), x, y, 9, B=16, num_warps=4)
    assert len(kernel.compiled) == 1
    assert kernel.launched == [(4, 2, 1, 77, "f", "m", None, None, None, x.data_ptr(), y.data_ptr(), 9, 16)]
    others = [(x, x[1:], 5, {}), (x, y.double(), 5, {}), (x, y, 2**40, {}), (x, y, 5, {"B": 32}), (x, y, 5, {"num_warps": 8})]
    for number, (*arguments, sizes) in enumerate(others, 2):
        for _ in range(2):
            triton.launch(kernel, (3,), *arguments, **({"B": 16, "num_warps": 4} | sizes))
        assert len(kernel.compiled) == number, "alignment, dtype, a number of 64 bits, constants and options count"
    kernel = Compiled()
    kernel.params[2].do_not_specialize = False
    for n in (5, 16, 5):
        triton.launch(kernel, (3,), x, y, n, B=16)
    assert len(kernel.compiled) == 2, "and numbers that it is compiled for"
