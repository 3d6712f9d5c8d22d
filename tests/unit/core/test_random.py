"""Random numbers on the device that uses them."""

import torch

from scene_experts.core import random


def test_on_the_cpu_it_is_the_generator_itself():
    generator = torch.Generator().manual_seed(3)
    assert random.generator_on(torch.device("cpu"), generator) is generator


def test_on_cuda_the_generator_s_state_decides_the_seed(monkeypatch):
    seeds = []

    class Generator:
        def __init__(self, device):
            assert device == torch.device("cuda", 1)

        def manual_seed(self, seed):
            seeds.append(seed)

    first = torch.Generator().manual_seed(3)
    state = first.get_state()
    monkeypatch.setattr(random.torch, "Generator", Generator)
    random.generator_on(torch.device("cuda", 1), first)
    random.generator_on(torch.device("cuda", 1), first)
    first.set_state(state)
    random.generator_on(torch.device("cuda", 1), first)
    assert seeds[0] == seeds[2] != seeds[1]
