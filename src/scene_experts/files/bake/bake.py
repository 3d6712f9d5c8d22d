"""The bake: a scene whose Gaussians depend on the camera becomes standard Gaussians, in which only
the harmonics' colours depend on it.

1. Sums (`observe.sum_views`, `closed_form`): every Gaussian that contributes to a picture becomes
   one row, with the mean position, size and rotation over the views, weighted by its contributions.
2. Omission (`observe.omission`): a row loses opacity the more often the scene leaves its Gaussian
   out.
3. Colours (`observe.fit_harmonics`): least squares over the views.
4. Refinement (`refine`): all parameters move together until the pictures agree.

Held-out views are never used.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.errors import InputError
from scene_experts.core.plain import to_json
from scene_experts.data.views import Capture
from scene_experts.files.bake.observe import Sums, fit_harmonics, omission, sum_views
from scene_experts.files.bake.refine import Refine, refine
from scene_experts.files.bake.views import Views
from scene_experts.files.gaussians.read import DRAWN_AT, scene_of
from scene_experts.files.measure import Painter, Tell
from scene_experts.render import Rasterizer
from scene_experts.scene.gaussians import GaussianScene
from scene_experts.training.run_folder import OpenRun

__all__ = ["DRAWN_AT", "Bake", "Baked", "Refine", "bake"]

OMISSION_VIEWS = 150  # free views, besides those of the sums, that show what the scene leaves out
MOST_OMISSION = 3.0  # Gaussians left out this many times as much as they are drawn are dropped
MOST_ALPHA = 0.995  # keeps logits finite
LEAST_ALPHA = 1.0 / 255.0  # rasterisers skip fainter Gaussians


@dataclass(frozen=True)
class Bake:
    """What a bake keeps of a scene, and how it is refined."""

    sh_degree: int = 3
    """Degree of the harmonics, 0 to 3."""
    max_gaussians: int = 0
    """Keep at most this many Gaussians, those with the largest contributions; 0 keeps all."""
    prune: float = 0.0
    """Share of all contributions to leave out, smallest first, in [0, 1)."""
    refine: Refine = field(default_factory=Refine)
    seed: int = 0
    """Of the free views and of the order of the views in the refinement."""


@dataclass(frozen=True)
class Baked:
    """A baked scene in the trained world."""

    scene: GaussianScene
    closed_form: GaussianScene | None
    """The same before its refinement; None for one that a run has kept."""
    about: dict[str, Any]
    """How it was baked, as JSON values: all settings, and how many Gaussians contributed to any
    view."""


def bake(run: OpenRun, capture: Capture, how: Bake, rasterize: Rasterizer | None, tell: Tell) -> Baked:
    """Bake the scene of a run from the training views of its capture.

    rasterize: None for the fastest one on this CPU. Raises InputError where no Gaussian contributes
    to any training view, and for a capture without training views.
    """
    scene, painter = run.scene, Painter.of(run.scene, run.step, rasterize, run.config.train.antialias)
    generator = torch.Generator().manual_seed(how.seed)
    views = Views.of(capture)
    cameras, slots = views.for_sums(generator), len(scene.positions) * scene.K
    sums = sum_views(painter, slots, cameras, tell)
    rows = (sums.weight > 0).nonzero().squeeze(1)
    about = {"bake": to_json(how), "contributing": len(rows)}
    columns, opacity = closed_form(sums, rows), sums.opacity().index_select(0, rows)
    if scene.traits.needs_bake:
        looks = [*cameras, *(views.free(generator) for _ in range(OMISSION_VIEWS))]
        sizes = columns["log_scales"].amax(1).exp()
        left_out = omission(painter, rows, slots, columns["means"], sizes, looks, tell)
        opacity = torch.where(left_out > MOST_OMISSION, 0.0, opacity / (1 + left_out))
    chosen = choose(sums.weight.index_select(0, rows), opacity, how)
    if not len(chosen):
        raise InputError("expected a scene that shows in its training views, found none of its Gaussians in any; train it longer")
    columns["raw_opacity"] = torch.logit(opacity.clamp(LEAST_ALPHA, MOST_ALPHA))
    rows, columns = rows[chosen], {name: value.index_select(0, chosen) for name, value in columns.items()}
    degree = how.sh_degree
    if scene.traits.sh_degree is not None:  # the rows are standard Gaussians: keep all but the colours
        degree = min(degree, scene.traits.sh_degree)
        columns = {name: scene.table.params[name].detach().index_select(0, rows) for name in columns}
    sh = fit_harmonics(painter, rows, sums, columns["means"], degree, cameras, tell)
    columns |= {"sh_dc": sh[:, 0].contiguous(), "sh_rest": sh[:, 1:].contiguous()}
    del sums, sh
    first = scene_of(columns, scene.extent)
    if how.refine.iterations == 0:
        return Baked(first, first, about)
    second = scene_of({name: value.clone() for name, value in columns.items()}, scene.extent)
    about["refined"] = refine(second, painter, views, torch.tensor(capture.background), how.refine, how.seed, tell)
    return Baked(without_faint(second), first, about)


def choose(weight: Tensor, opacity: Tensor, how: Bake) -> Tensor:
    """The Gaussians [k] int64, ascending, that a bake keeps of those with contributions `weight`
    [n] and opacities [n]."""
    order = weight.argsort(descending=True)
    sorted_ = weight.index_select(0, order).double()
    before = (sorted_.cumsum(0) - sorted_) / sorted_.sum().clamp_min(1e-12)
    chosen = (sorted_ > 0) & (opacity.index_select(0, order) >= LEAST_ALPHA)
    if how.prune > 0:
        chosen &= before < 1 - how.prune
    out = order[chosen]
    return (out[: how.max_gaussians] if how.max_gaussians else out).sort().values


def closed_form(sums: Sums, rows: Tensor) -> dict[str, Tensor]:
    """Means over the views, weighted by contribution, of the slots `rows` [n]: means, log_scales
    and quats of standard Gaussians."""
    weight = sums.weight.index_select(0, rows)[:, None]
    return {
        "means": sums.means.index_select(0, rows) / weight,
        "log_scales": sums.log_scales.index_select(0, rows) / weight,
        "quats": functional.normalize(sums.quats.index_select(0, rows), dim=1),
    }


@torch.no_grad()
def without_faint(scene: GaussianScene) -> GaussianScene:
    """The scene without Gaussians that are too faint to be drawn."""
    p = scene.table.params
    rows = (p["raw_opacity"].sigmoid() >= LEAST_ALPHA).nonzero().squeeze(1)
    return scene_of({name: value.detach().index_select(0, rows) for name, value in p.items()}, scene.extent)
