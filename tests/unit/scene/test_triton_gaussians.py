"""The kernels of explicit Gaussians against plain torch in float64."""

from dataclasses import replace

import pytest
import torch
from torch.nn import functional

from scene_experts.core.gradients import GaussianGradients, Regularisers
from scene_experts.core.types import Camera
from scene_experts.geometry.sh import sh_to_rgb
from scene_experts.scene.gaussians_direct import COLUMNS, DirectGaussians
from support.explicit import make_gaussians
from support.interpret import DEVICE, compile_for_gpu, kernels

MODULE = "scene_experts.scene.triton_gaussians"
TERMS = Regularisers(volume=0.7, mean_opacity=0.3, mean_size=0.2)


def decode(p, rows, position, degree):
    """The equations of 3DGS, for any dtype."""
    means, sh = p["means"][rows], torch.cat([p["sh_dc"][:, None], p["sh_rest"]], dim=1)[rows]
    quats = functional.normalize(p["quats"][rows], dim=1)
    return means, quats, p["log_scales"][rows].exp(), p["raw_opacity"][rows].sigmoid(), sh_to_rgb(sh, means - position, degree)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seen", [150, 1, 0])
def test_value_and_gradients_are_the_equations(degree, seen):
    kernels(MODULE)
    scene = make_gaussians().to(DEVICE)
    for parameter in scene.table.params.values():
        parameter.grad = None
    scene.config = replace(scene.config, sh_ramp=10)
    rows = torch.randperm(200, generator=torch.Generator().manual_seed(1))[:seen].sort().values.to(DEVICE)
    scene.visible = lambda camera, cull: rows
    pose = torch.eye(4)
    pose[:3, 3] = torch.tensor([0.3, -0.2, 1.5])
    camera = Camera(pose.to(DEVICE), torch.eye(3, device=DEVICE), 40, 30)
    decoded, backward = DirectGaussians(scene).draw(camera, 10 * degree if degree else 1, None)
    exact = {name: scene.table.params[name].detach().double().requires_grad_() for name in COLUMNS}
    expected = decode(exact, rows, camera.position.double(), degree)
    g = decoded.gaussians
    found = (g.means, g.quats, g.scales, g.opacities, g.colors)
    for a, b in zip(found, expected):
        torch.testing.assert_close(a.double(), b.detach(), rtol=2e-6, atol=2e-6)
    up = [torch.randn(t.shape, generator=torch.Generator().manual_seed(2)).to(DEVICE) for t in expected]
    loss = sum((a * b.double()).sum() for a, b in zip(expected, up)) + 0.7 * expected[2].prod(1).sum() / max(seen, 1)
    (loss + 0.3 * exact["raw_opacity"].sigmoid().mean() + 0.2 * exact["log_scales"].exp().mean()).backward()
    with torch.no_grad():
        backward(GaussianGradients(*up), TERMS)
        once = {name: scene.table.params[name].grad.clone() for name in COLUMNS}
        for name in COLUMNS:
            torch.testing.assert_close(once[name].double(), exact[name].grad, rtol=1e-5, atol=2e-6, msg=name)
        backward(GaussianGradients(*up), TERMS)  # a second view of a batch adds up
        for name in COLUMNS:
            torch.testing.assert_close(scene.table.params[name].grad, 2 * once[name])


@pytest.mark.slow
@pytest.mark.parametrize("target", [80, 90])
@pytest.mark.parametrize("name", ["decode", "backward"])
def test_they_compile(name, target):
    types = {"rows": "*i64", "A": "i32", "volume": "fp32"}
    pointers = dict.fromkeys(getattr(kernels(MODULE), name).arg_names, "*fp32")
    compile_for_gpu(MODULE, name, {**pointers, **types}, {"REST": 15, "COUNT": 16, "B": 128}, target)
