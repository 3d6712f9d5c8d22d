"""Which networks the kernels cover, and where their tensors lie."""

from dataclasses import replace

import torch

from scene_experts.scene.anchors.mlp import ATTRIBUTES, HeadWeights
from scene_experts.scene.anchors.triton_networks import KernelNetworks, covers, pad
from support.decoding import problem


def test_wide_and_deep_networks_are_not_covered():
    heads = problem(A=4)[3]
    assert all(covers(a, heads[a], 8, 4) for a in ATTRIBUTES)
    assert not covers("cov", replace(heads["cov"], middle_w=torch.zeros(3, 1, 16, 16), middle_b=torch.zeros(3, 1, 16)), 8, 4)
    wide = HeadWeights(None, None, torch.zeros(1, 200, 35), torch.zeros(1, 200), torch.zeros(1, 70, 200), torch.zeros(1, 70), None)
    assert not covers("cov", wide, 32, 10)


def test_tiles_are_powers_of_two():
    assert [pad(n) for n in (1, 16, 17, 36, 70)] == [16, 16, 32, 64, 128] and pad(5, 1) == 8


def test_the_tensors_of_all_networks_fill_one_array():
    _, _, _, heads, with_dist = problem(A=4, E=5, k=2)
    nets = KernelNetworks(heads, with_dist, 8, 4)
    flat = torch.arange(float(nets.width))
    parts = nets.split(flat)
    tensors = [getattr(heads[a], name) for a in ATTRIBUTES for name in ("w1", "b1", "w2", "b2")]
    tensors += [t for a in ATTRIBUTES for t in (heads[a].router_w, heads[a].router_b) if t is not None]
    assert [p.shape for p in parts] == [t.shape for t in tensors]
    assert torch.equal(torch.cat([p.flatten() for p in parts]), flat)
