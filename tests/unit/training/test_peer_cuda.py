"""The peer of the CUDA benchmarks keeps its own loss, and in plain torch it is that of the project."""

import ast

import pytest
import torch

from peer_cuda import loss
from scene_experts.training.photometric import photometric
from support.places import ROOT

SHARED = {"core", "core.types", "data.capture", "data.settings", "geometry.neighbours", "geometry.sh"}


def test_it_takes_nothing_that_gets_faster_from_the_project():
    used = set()
    for path in [ROOT / "benchmarks" / "explicit_gsplat.py", *(ROOT / "benchmarks" / "peer_cuda").glob("*.py")]:
        nodes = ast.walk(ast.parse(path.read_text()))
        used |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module and "scene_experts" in node.module}
    assert used == {f"scene_experts.{name}" for name in SHARED}


@pytest.mark.parametrize("masked", [False, True])
def test_its_loss_in_torch_is_that_of_the_project(masked):
    image, target = torch.rand(2, 30, 41, 3, dtype=torch.float64)
    mask = (torch.rand(30, 41) > 0.3).double() if masked else None
    ours, theirs = image.clone().requires_grad_(), image.clone().requires_grad_()
    found, expected = loss.photometric(ours, target, 0.2, mask, "torch"), photometric(theirs, target, 0.2, mask)
    torch.testing.assert_close(torch.stack(found), torch.stack(expected), rtol=1e-9, atol=1e-12)
    sum(found).backward(), sum(expected).backward()
    torch.testing.assert_close(ours.grad, theirs.grad, rtol=1e-7, atol=1e-12)
