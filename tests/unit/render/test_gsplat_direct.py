"""The compiled functions of gsplat without autograd. `make pretend` compares whole steps with those of the CPU."""

from types import SimpleNamespace

import pytest
import torch

from scene_experts.render import draw_with_gradients, explain_indirect, gsplat_direct
from scene_experts.render.gsplat import GsplatRasterizer
from scene_experts.render.reference import ReferenceRasterizer
from support.gaussians import make_camera, make_scene
from support.interpret import DEVICE


def test_another_gsplat_is_left_to_autograd(monkeypatch):
    gsplat_direct.explain_unknown.cache_clear()
    monkeypatch.setattr(gsplat_direct.importlib, "import_module", lambda name: SimpleNamespace(__version__="9.9"))
    assert "9.9" in (gsplat_direct.explain_unknown() or "")
    gsplat_direct.explain_unknown.cache_clear()
    monkeypatch.setattr(gsplat_direct.importlib, "import_module", lambda name: SimpleNamespace(__version__=gsplat_direct.KNOWN))
    assert gsplat_direct.explain_unknown() is None
    gsplat_direct.explain_unknown.cache_clear()
    assert explain_indirect(GsplatRasterizer()) == "a picture with depth"
    assert "reference" in (explain_indirect(ReferenceRasterizer()) or "")


def test_gradients_of_what_nothing_depends_on_come_from_one_array():
    device = torch.device("cpu")
    few, many = gsplat_direct._nothing(3, device), gsplat_direct._nothing(50, device)
    assert few.shape == (3,) and many.shape == (50,) and not many.any()
    assert gsplat_direct._nothing(40, device).data_ptr() == many.data_ptr()
    del gsplat_direct._zeros[device]


def compare(draw, device, close):
    """Gradients with `draw_with_gradients` and through autograd."""
    scene, camera, background = make_scene(60, seed=1), make_camera(40, 30).to(device, torch.float32), torch.tensor([0.1, 0.5, 0.2])
    leaves = {n: getattr(scene, n).float().to(device).requires_grad_() for n in ("means", "quats", "scales", "opacities", "colors")}
    g = type(scene)(**leaves, source=scene.source.to(device))
    up = torch.randn(30, 40, 3, generator=torch.Generator().manual_seed(2)).to(device)
    expected = draw(g, camera, background.to(device))
    (expected.image * up).sum().backward()
    with torch.no_grad():
        render, backward = draw_with_gradients(draw, g, camera, background.to(device))
        gradients = backward(up)
    torch.testing.assert_close(render.image, expected.image.detach())
    assert torch.equal(render.radii, expected.radii) and not render.image.requires_grad
    torch.testing.assert_close(render.mean2d_grad, expected.mean2d_grad, rtol=close, atol=close)
    for name, leaf in leaves.items():
        torch.testing.assert_close(getattr(gradients, name), leaf.grad, rtol=close, atol=close, msg=name)


def test_a_rasteriser_of_its_own_goes_through_autograd():
    compare(ReferenceRasterizer(), "cpu", 1e-6)


@pytest.mark.gpu
@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("absolute", [False, True])
def test_pictures_and_gradients_are_those_of_gsplat_through_autograd(antialias, absolute):
    compare(GsplatRasterizer(antialias=antialias, absolute=absolute, depth=False), DEVICE, 1e-4)
