"""LPIPS against values that torchmetrics documented, against its definition, and in strips against the whole."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.evaluate import lpips, weights
from scene_experts.evaluate.lpips import BACKBONES, SCALE, SHIFT, Lpips
from support.lpips import random_tensors
from support.messages import naming


def definition(net: str, tensors: dict[str, Tensor], x: Tensor, y: Tensor) -> float:
    """Compute the formula at the head of lpips.py layer by layer in float64, one picture after the other."""
    features = []
    for picture in (x, y):
        f = (picture.double().permute(2, 0, 1) - torch.tensor(SHIFT).double()[:, None, None]) / torch.tensor(SCALE).double()[:, None, None]
        f, i, levels = f[None], 0, []
        for stage in BACKBONES[net]:
            f = functional.max_pool2d(f, *stage.pool) if stage.pool else f
            for conv in stage.convs:
                w, b = tensors[f"conv{i}.weight"].double(), tensors[f"conv{i}.bias"].double()
                f = functional.conv2d(f, w, b, conv.stride, conv.padding).relu()
                i += 1
            levels.append(f[0])
        features.append(levels)
    total = 0.0
    for level, (a, b) in enumerate(zip(*features)):
        squared = (a / (a.norm(dim=0) + 1e-10) - b / (b.norm(dim=0) + 1e-10)).square()
        total += float((squared * tensors[f"lin{level}"].double()[:, None, None]).sum(0).mean())
    return total


@pytest.mark.parametrize(("net", "height", "width"), [("vgg", 45, 39), ("vgg", 16, 16), ("alex", 64, 51), ("alex", 31, 31)])
def test_definition(net: str, height: int, width: int) -> None:
    tensors = random_tensors(net)
    gen = torch.Generator().manual_seed(1)
    x, y = (2 * torch.rand(height, width, 3, generator=gen) - 1 for _ in range(2))
    assert Lpips(net, tensors)(x, y) == pytest.approx(definition(net, tensors, x, y), rel=1e-5)


def test_strips_give_the_value_of_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    network = Lpips("vgg", random_tensors("vgg"))
    gen = torch.Generator().manual_seed(2)
    x, y = (2 * torch.rand(75, 41, 3, generator=gen) - 1 for _ in range(2))
    whole = network(x, y)
    monkeypatch.setattr(lpips, "STRIP", 1)  # strips of 8 rows at every stage
    assert network(x, y) == pytest.approx(whole, rel=1e-6)


def test_identical_pictures_are_at_distance_zero() -> None:
    x = torch.rand(40, 40, 3, generator=torch.Generator().manual_seed(3))
    assert Lpips("alex", random_tensors("alex"))(x, x) == 0.0


def test_unusable_pictures_and_weights_are_rejected() -> None:
    network = Lpips("alex", random_tensors("alex"))
    with pytest.raises(InputError, match="31"):
        network(torch.zeros(30, 60, 3), torch.zeros(30, 60, 3))
    with pytest.raises(ValueError, match=naming(40, 41)):
        network(torch.zeros(40, 40, 3), torch.zeros(40, 41, 3))
    with pytest.raises(InputError, match="lin4"):
        Lpips("alex", {k: v for k, v in random_tensors("alex").items() if k != "lin4"})


@pytest.mark.slow
def test_documented_values() -> None:
    """torchmetrics 0.x documented two values for VGG: for random pictures, and for the same pictures rescaled to [-1, 1].

    Its example sets the seed, builds the network, whose initial weights consume random numbers, and then draws the pictures.
    """
    try:
        tensors, _ = weights.load("vgg")
    except weights.MissingWeights as error:
        pytest.skip(str(error))
    network = Lpips("vgg", tensors)
    torch.manual_seed(123)
    for stage in BACKBONES["vgg"]:
        for conv in stage.convs:
            nn.Conv2d(conv.inputs, conv.outputs, conv.kernel)
    for inputs, outputs in ((25088, 4096), (4096, 4096), (4096, 1000)):
        nn.Linear(inputs, outputs)
    for stage in BACKBONES["vgg"]:
        nn.Conv2d(stage.convs[-1].outputs, 1, 1, bias=False)
    x, y = (torch.rand(10, 3, 100, 100).permute(0, 2, 3, 1) for _ in range(2))
    as_drawn = sum(network(a, b) for a, b in zip(x, y)) / 10
    rescaled = sum(network(2 * a - 1, 2 * b - 1) for a, b in zip(x, y)) / 10
    assert as_drawn == pytest.approx(0.3566, abs=5e-5)
    assert rescaled == pytest.approx(0.3493, abs=5e-5)
