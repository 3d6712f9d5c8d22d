"""Whether Triton kernels can run, and on which device."""

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
