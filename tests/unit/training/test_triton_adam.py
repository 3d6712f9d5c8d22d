"""One Adam step as a Triton kernel against the plain torch form."""

import pytest
import torch

from scene_experts.training import optim
from scene_experts.training.optim import FusedAdam
from support.interpret import DEVICE, compile_for_gpu, kernels


@pytest.fixture(autouse=True)
def _small(monkeypatch):
    kernels("scene_experts.training.triton_adam")
    monkeypatch.setattr(optim, "BLOCK", 64)


def optimizers():
    """The Triton form and the torch form, with the same parameters: two columns of a table, a matrix, and one that has no gradient."""
    torch.manual_seed(0)
    shapes = {"feature": (40, 5), "offsets": (40, 3, 3), "weight": (7, 11), "bias": (), "unused": (4,)}
    made = []
    for form in ("triton", "torch"):
        torch.manual_seed(1)
        values = {name: torch.nn.Parameter(torch.randn(shape, device=DEVICE)) for name, shape in shapes.items()}
        groups = [{"params": [p], "name": name, "lr": 0.01, "by_row": p.shape[:1] == (40,)} for name, p in values.items()]
        adam = FusedAdam(groups, eps=1e-8)
        adam._native, adam._triton = False, form == "triton"
        made.append(adam)
    return made


def fill(adam, step):
    torch.manual_seed(100 + step)
    for group in adam.param_groups:
        (p,) = group["params"]
        if group["name"] != "unused":
            p.grad = torch.randn(p.shape, device=DEVICE)


@pytest.mark.parametrize("form", ["all rows", "some rows", "no rows"])
def test_the_step_of_torch(form):
    ours, exact = optimizers()
    rows = {"all rows": torch.arange(40), "some rows": torch.tensor([39, 3, 17]), "no rows": torch.zeros(0, dtype=torch.int64)}[form]
    for step in range(3):
        fill(ours, step), fill(exact, step)
        chosen = None if form == "all rows" and step == 1 else rows.to(DEVICE)
        ours.step(rows=chosen)
        exact.step(rows=rows.to(DEVICE))
    for a, b in zip(ours.param_groups, exact.param_groups):
        (p,), (q,) = a["params"], b["params"]
        torch.testing.assert_close(p, q, rtol=1e-6, atol=1e-7)
        assert ours.state[p].keys() == exact.state[q].keys()
        for key, value in exact.state[q].items():
            torch.testing.assert_close(ours.state[p][key].cpu(), value.cpu(), rtol=1e-6, atol=1e-7)
    assert not ours.state[ours.param_groups[-1]["params"][0]]


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
def test_it_compiles(target):
    compile_for_gpu("scene_experts.training.triton_adam", "step", {"table": "*i64", "count": "i32"}, {"B": 1024}, target)
