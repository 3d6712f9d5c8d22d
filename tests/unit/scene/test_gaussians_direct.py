"""Views of explicit Gaussians without autograd: test_triton_gaussians.py has the kernels, test_direct.py whole views."""

import torch

from scene_experts.scene.gaussians_direct import COLUMNS, DirectGaussians
from support.explicit import make_gaussians


def test_gradients_are_views_of_one_array():
    scene = make_gaussians(n=7)
    made = DirectGaussians(scene)
    made.gradients.fill_(1.0)
    assert [p is scene.table.params[name] for (p, _), name in zip(made.grads.pairs, COLUMNS, strict=True)] == [True] * 6
    assert all(g.shape == p.shape and torch.equal(g, torch.ones_like(p)) for p, g in made.grads.pairs)
    assert made.gradients.numel() >= 7 * 59 and made.gradients.sum() == made.gradients.numel()
