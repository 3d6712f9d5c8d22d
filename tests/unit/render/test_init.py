"""The choice of a rasteriser: `auto`, and rasterisers that cannot be used."""

from dataclasses import dataclass, replace
from types import SimpleNamespace

import pytest
import torch

from scene_experts import render
from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians
from scene_experts.native import library as native
from scene_experts.render import NAMES, as_trained, choose, for_training, gsplat_install
from support.messages import naming


def test_auto_on_the_cpu_is_the_compiled_one_where_it_loads():
    assert choose("auto", "cpu").name == ("cpu" if native.load() is not None else "reference")


def test_auto_without_a_library_warns_once_and_takes_the_reference(monkeypatch):
    monkeypatch.setattr(native, "load", lambda level=None: None)
    render._warn.cache_clear()
    with pytest.warns(UserWarning, match="reference"):
        assert choose("auto", "cpu").name == "reference"
    render._warn.cache_clear()


def test_auto_on_a_device_without_a_fast_one_takes_the_reference():
    render._warn.cache_clear()
    with pytest.warns(UserWarning, match="reference"):
        assert choose("auto", "meta").name == "reference"
    render._warn.cache_clear()


def test_auto_on_cuda_without_gsplat_stops_and_says_what_to_install(monkeypatch):
    monkeypatch.setattr(gsplat_install, "explain_missing", lambda: "gsplat is missing: run `pip install gsplat`, or use --device cpu")
    with pytest.raises(InputError, match=naming("pip install gsplat", "--device cpu")):
        choose("auto", "cuda")


@pytest.mark.parametrize(
    ("name", "device", "others"),
    [
        ("gsplat", "cpu", ("cpu", "reference")),
        ("cpu", "cuda", ("gsplat", "reference")),
        ("opengl", "cpu", NAMES),
    ],
)
def test_an_unusable_rasteriser_names_the_usable_ones(name, device, others):
    with pytest.raises(InputError, match=naming(*others)):
        choose(name, device)


@pytest.mark.parametrize("name", ["reference", "cpu"])
def test_options_reach_the_rasteriser(name):
    if name == "cpu" and native.load() is None:
        pytest.skip(str(native.explain_missing()))
    assert choose(name, "cpu", antialias=True).antialias and not choose(name, "cpu").antialias


@pytest.mark.parametrize("name", ["reference", "cpu"])
def test_channels_come_out_in_the_order_they_went_in(name):
    if name == "cpu" and native.load() is None:
        pytest.skip(str(native.explain_missing()))
    camera = Camera(torch.eye(4), torch.tensor([[20.0, 0, 5], [0, 20, 11], [0, 0, 1]]), 24, 16)
    place, turn, colour = torch.tensor([[0.0, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[0.9, 0.5, 0.1]])
    one = Gaussians(place, turn, torch.full((1, 3), 0.1), torch.ones(1), colour, torch.zeros(1, dtype=torch.int64))
    picture = choose(name, "cpu")(one, camera, torch.tensor([0.0, 0.1, 0.2])).image
    brightest = torch.nonzero(picture[..., 0] == picture[..., 0].max())[0]
    assert brightest[0] in (10, 11) and brightest[1] in (4, 5), "row about cy, column about cx"
    assert picture[10, 4, 0] > 0.7 and 0.4 < picture[10, 4, 1] < 0.5 and picture[10, 4, 2] < 0.15
    torch.testing.assert_close(picture[0, -1], torch.tensor([0.0, 0.1, 0.2]))


def test_a_rasteriser_is_as_the_run_was_trained():
    draw = choose("reference", "cpu")
    assert as_trained(draw, False) is draw and as_trained(draw, True) == replace(draw, antialias=True)  # type: ignore[type-var]
    plain = object()  # a rasteriser without compensation
    assert as_trained(plain, True) is plain  # type: ignore[arg-type]


@dataclass(frozen=True)
class SimpleDepth:
    """A rasteriser that can leave out the depth."""

    depth: bool = True


def test_growth_asks_for_absolute_gradients():
    draw = choose("reference", "cpu")
    assert for_training(draw, False) is draw and for_training(draw, True) == replace(draw, absolute=True)  # type: ignore[type-var]
    drawn = for_training(SimpleDepth(), False)
    assert not drawn.depth and for_training(drawn, False, depth=True).depth
    with pytest.raises(InputError, match=r"--growth\.gradient"):
        for_training(SimpleNamespace(name="mine"), True)  # type: ignore[arg-type]


def test_gsplat_says_that_it_is_not_deterministic():
    with pytest.warns(UserWarning, match="--device cpu"):
        assert choose("gsplat", "cuda", deterministic=True).name == "gsplat"
