"""TorchScript networks: torch runs what was written, and networks of another form are refused."""

import pytest
import torch
from torch import nn
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.files.anchors import torchscript
from support.messages import naming

pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.*:DeprecationWarning")
OUT = {"opacity": 10, "cov": 70, "color": 30}


def made(experts=1, middle=0, D=35, H=32):
    g = torch.Generator().manual_seed(2)
    new = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    found = {a: {"w1": new(experts, H, D), "b1": new(experts, H), "w2": new(experts, n, H), "b2": new(experts, n)} for a, n in OUT.items()}
    for network in found.values():
        for i in range(middle):
            network |= {f"middle.{i}.weight": new(H, H), f"middle.{i}.bias": new(H)}
        if experts > 1:
            network |= {"router_w": new(experts, 32), "router_b": new(experts)}
    return found


def same(a, b):
    return a.keys() == b.keys() and all(a[k].keys() == b[k].keys() and all(torch.equal(a[k][n], b[k][n]) for n in a[k]) for k in a)


@pytest.mark.parametrize("middle", [0, 1, 3])
def test_torch_runs_the_written_network_and_we_read_it_back(tmp_path, middle):
    wanted = made(middle=middle)
    torchscript.write(tmp_path, wanted)
    x = torch.randn(7, 35, generator=torch.Generator().manual_seed(0))
    for attribute, last in (("opacity", torch.tanh), ("cov", lambda y: y), ("color", torch.sigmoid)):
        n = wanted[attribute]
        h = functional.relu(x @ n["w1"][0].T + n["b1"][0])
        for i in range(middle):
            h = functional.relu(h @ n[f"middle.{i}.weight"].T + n[f"middle.{i}.bias"])
        torch.testing.assert_close(torch.jit.load(str(tmp_path / torchscript.FILES[attribute]))(x), last(h @ n["w2"][0].T + n["b2"][0]))
    assert same(torchscript.read(tmp_path), wanted)


def test_an_absent_or_foreign_network_is_named(tmp_path):
    torchscript.write(tmp_path, made())
    (tmp_path / "cov_mlp.pt").unlink()
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        torchscript.read(tmp_path)
    torch.jit.save(torch.jit.trace(nn.Conv2d(3, 4, 3), (torch.zeros(1, 3, 8, 8),)), str(tmp_path / "cov_mlp.pt"))
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        torchscript.read(tmp_path)
    torch.jit.save(torch.jit.trace(nn.Sequential(nn.Linear(35, 32)), (torch.zeros(1, 35),)), str(tmp_path / "cov_mlp.pt"))
    with pytest.raises(InputError, match=naming("cov_mlp.pt")):
        torchscript.read(tmp_path)
