"""Scenes of anchors for the tests of compact files."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.files.anchors.data import AnchorData, by_file_name
from scene_experts.files.anchors.precision import Precision, from_spread

K, F = 4, 6
ORIGIN = (-1.5, 20.25, 0.1 + 0.2)
ABOUT = {"recipe": "moe-gs", "step": 7, "add_dist": {"opacity": False, "cov": True, "color": False}, "world": {"scale": 40.0}}
_OUT = {"opacity": K, "cov": 7 * K, "color": 3 * K}


def make_networks(E: int = 3) -> dict[str, Tensor]:
    """Networks of experts that differ little, with learned routers."""
    g = torch.Generator().manual_seed(1)
    new = lambda *shape: torch.randn(*shape, generator=g)  # noqa: E731
    shared = {a: new(8, F + 3 + (a == "cov")) for a in _OUT}
    shared["cov"][:, -1] *= 40  # the distance, in another unit than that of the training
    out = {}
    for a, n in _OUT.items():
        first, router = {"w1": shared[a] + 0.1 * new(E, *shared[a].shape), "b1": new(E, 8)}, {"router_w": new(E, F), "router_b": new(E)}
        out[a] = {**first, "w2": new(E, n, 8), "b2": new(E, n), **router}
    return by_file_name(out)


def make_scene(n: int = 300, seed: int = 0, spread: int = 40, **columns: Tensor) -> AnchorData:
    """Anchors on a sphere of cells, with classes of all sizes. Each row's first feature is its number, and exact. With the column level,
    cells of several lattices."""
    g = torch.Generator().manual_seed(seed)
    direction = torch.nn.functional.normalize(torch.randn(n, 3, generator=g), dim=1)
    feature = torch.randn(n, F, generator=g) * 2
    feature[:, 0] = torch.arange(n)
    found = {"feature": feature, "log_scaling": torch.randn(n, 6, generator=g) - 5, "offsets": torch.randn(n, K, 3, generator=g) ** 3}
    cells, edges = (direction * spread).round().long(), (0.0013,)
    if "level" in columns:
        top = int(columns["level"].max())
        cells, edges = cells // (2 ** (top - columns["level"]))[:, None], tuple(0.0013 * 2.0 ** (top - j) for j in range(top + 1))
    data = AnchorData({"xyz": torch.zeros(n, 3), **found, **columns}, make_networks(), ABOUT, cells, 0.0013, ORIGIN, ("cov",))
    p = from_spread(data.columns, data.networks)
    steps = {**p.steps, "feature": torch.cat([torch.tensor([1 / 16]), p.steps["feature"][1:]])}
    return replace(data, edges=edges if "level" in columns else (), precision=Precision(steps, torch.arange(n) % 7 - 2, p.networks))
