"""Random numbers on the device that uses them."""

from __future__ import annotations

import torch


def generator_on(device: torch.device, generator: torch.Generator) -> torch.Generator:
    """Return a generator for `device`: `generator` itself on the CPU, otherwise a new one that
    `generator` seeds.

    A million numbers from the CPU take longer to draw and to copy than a whole training step on a
    GPU. The state of `generator` still decides all numbers, so that a checkpoint needs no other
    state.
    """
    if device.type != "cuda":
        return generator
    seed = int(torch.randint(1 << 62, (), generator=generator))
    return torch.Generator(device).manual_seed(seed)
