"""Draw scenes with the adapter and gsplat's own wrappers, and with the reference; print the differences as JSON.

    python -m support.pretend.adapter                                        # in tests/; no tensor pretends here

One dictionary for each scene. `radii`: whether all radii are equal. `finite`: whether all gradients are finite, although gsplat leaves the
values of hidden Gaussians uninitialised. `picture`: the largest difference of colours. `depth`: the mean difference of the depth pictures.
`gradients`: by name, the norm of the difference relative to the norm. gsplat normalises quaternions, so their gradient is compared without
the component along the quaternion.
"""

import json
import sys
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import support.pretend.gsplat_stand_in  # noqa: F401  before gsplat is imported
from scene_experts.core.types import Gaussians, Render
from scene_experts.render import Rasterizer, gsplat
from scene_experts.render.gsplat import GsplatRasterizer
from scene_experts.render.reference import ReferenceRasterizer
from support.gaussians import make_camera, make_scene

COLUMNS = ("means", "quats", "scales", "opacities", "colors")
BACKGROUND = torch.tensor([0.2, 0.7, 0.1])
FAINT = 0.004  # every seventh Gaussian, as in anchor scenes; below 1/255 nothing is drawn


@dataclass(frozen=True)
class Case:
    """A scene of random Gaussians and how it is drawn."""

    name: str
    size: float = 0.04
    spread: float = 1.0
    centre: tuple[float, float] | None = None  # principal point, px; None: the middle
    antialias: bool = False
    most: float = 0.98  # opacity; gsplat 1.5 and the reference stop at different alphas above


CASES = (
    Case("plain"),
    Case("antialiased", antialias=True),
    Case("off-centre", centre=(90.0, 40.5)),
    Case("off-centre, wide, antialiased", size=0.02, spread=1.6, centre=(90.0, 40.5), antialias=True),
    Case("large, many on each pixel", size=0.1),
    Case("smaller than pixels, antialiased", size=0.003, antialias=True),
)


def draw(rasterize: Rasterizer, scene: Gaussians, case: Case) -> tuple[Render, dict[str, Tensor]]:
    """The picture and the gradients of a function of colours, depth and alpha."""
    camera = make_camera(149, 117, *(case.centre or (None, None)), f=140.0).to(dtype=torch.float32)
    leaves = {name: getattr(scene, name).float().requires_grad_() for name in COLUMNS}
    render = rasterize(replace(scene, **leaves), camera, BACKGROUND)
    weights = torch.linspace(-1, 1, render.alpha.numel()).view_as(render.alpha)
    (render.image.square().sum() + (weights * (render.depth + 3 * render.alpha)).sum()).backward()
    found = {name: leaf.grad for name, leaf in leaves.items() if leaf.grad is not None} | {"mean2d": render.mean2d_grad}
    quats = leaves["quats"].detach()
    found["quats"] = found["quats"] - (found["quats"] * quats).sum(1, keepdim=True) * quats
    return render, found


def measure(case: Case, seed: int) -> dict[str, Any]:
    """The differences for a scene."""
    scene = make_scene(800, seed, case.size, case.spread)
    opacities = scene.opacities.clamp_max(case.most)
    opacities[::7] *= FAINT
    scene = replace(scene, opacities=opacities)
    ours, by_ours = draw(GsplatRasterizer(antialias=case.antialias), scene, case)
    expected, by_expected = draw(ReferenceRasterizer(antialias=case.antialias), scene, case)
    return {
        "radii": torch.equal(ours.radii, expected.radii),
        "finite": all(bool(g.isfinite().all()) for g in by_ours.values()),
        "picture": float((ours.image - expected.image).detach().abs().max()),
        "depth": float((ours.depth - expected.depth).detach().abs().mean()),
        "gradients": {name: float((g - by_expected[name]).norm() / by_expected[name].norm()) for name, g in by_ours.items()},
    }


def main() -> int:
    gsplat.explain_missing = lambda: None
    print(json.dumps({case.name: measure(case, seed) for seed, case in enumerate(CASES)}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
