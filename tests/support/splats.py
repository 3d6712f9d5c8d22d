"""Random Gaussians as the standard formats hold them."""

import torch

from scene_experts.files.formats.splats import Splats


def splats(n=5, degree=3, seed=0) -> Splats:
    """Return n Gaussians with normally distributed values."""
    g = torch.Generator().manual_seed(seed)
    new = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    return Splats(new(n, 3), new(n, 3), new(n, 4), new(n), new(n, (degree + 1) ** 2, 3))
