"""The bake: a scene whose Gaussians depend on the camera as standard Gaussians, which do not but for their harmonics.

Every decoded Gaussian that contributes to a training view becomes one standard Gaussian. Its opacity, size, rotation and colour are means
over the views, weighted by what it contributed (`sums`), its opacity less where the scene often leaves it out; then all parameters
are moved together until the pictures agree (`refine`). Views held out are never looked at.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.core.errors import InputError, expect_at_least
from scene_experts.core.table import Table
from scene_experts.data.views import Capture
from scene_experts.files.bake.refine import Refine, refine
from scene_experts.files.bake.sums import Sums, Tell, add_up, fit_harmonics, hidden
from scene_experts.files.bake.views import Views
from scene_experts.geometry.sh import MAX_DEGREE
from scene_experts.render import Rasterizer
from scene_experts.scene import Scene
from scene_experts.scene.gaussians import Explicit, GaussianScene

FREE_LOOKS = 150  # free views, beside the others, from which is seen what the scene leaves out
MOSTLY = 3.0  # Gaussians left out more than so many times as much as they are drawn are dropped, and the others take their place
MOST_ALPHA = 0.995  # so that logits stay finite
LEAST_ALPHA = 1.0 / 255.0  # rasterisers leave out what is fainter: such a Gaussian is drawn nowhere


@dataclass(frozen=True)
class Bake:
    """How much of a scene a bake keeps, and how long it is refined."""

    sh_degree: int = 3
    max_gaussians: int = 0  # 0: no cap
    prune: float = 0.0  # those that contribute least go, until they hold this share of all contributions
    refine: Refine = field(default_factory=Refine)
    seed: int = 0

    def check(self) -> None:
        """Raises InputError for numbers that no bake can have."""
        expect_at_least([("--sh-degree", self.sh_degree, 0), ("--max-gaussians", self.max_gaussians, 0)])
        expect_at_least([("--refine", self.refine.iterations, 0), ("--seed", self.seed, 0)])
        if self.sh_degree > MAX_DEGREE:
            raise InputError(f"expected --sh-degree of at most {MAX_DEGREE}, found {self.sh_degree}; give a lower degree")
        if not 0 <= self.prune < 1:
            raise InputError(f"expected --prune as a share of 0 to below 1, found {self.prune}; correct it")


@dataclass(frozen=True)
class Baked:
    """A baked scene in the trained world, the same before its refinement, and how many Gaussians there were on the way."""

    scene: GaussianScene
    closed_form: GaussianScene
    contributing: int  # Gaussians that any view showed


def bake(scene: Scene, step: int, capture: Capture, rasterize: Rasterizer, how: Bake, tell: Tell) -> Baked:
    """Bake `scene` as it is at `step`, over the training views of its capture.

    rasterize: as the scene was trained (antialias). Raises InputError where no Gaussian shows in any training view.
    """
    how.check()
    generator = torch.Generator().manual_seed(how.seed)
    views, draws = Views.of(capture), scene.frozen(step)
    cameras, slots = views.for_sums(generator), len(scene.table) * scene.K
    sums = add_up(draws, step, slots, cameras, rasterize, tell)
    rows = (sums.weight > 0).nonzero().squeeze(1)
    found, columns, opacity = len(rows), closed_form(sums, rows), sums.opacity().index_select(0, rows)
    if not isinstance(scene, GaussianScene):
        looks = [*cameras, *(views.free(generator) for _ in range(FREE_LOOKS))]
        sizes = columns["log_scales"].amax(1).exp()
        left_out = hidden(draws, step, rows, slots, columns["means"], sizes, looks, rasterize, tell)
        opacity = torch.where(left_out > MOSTLY, 0.0, opacity / (1 + left_out))
    chosen = kept(sums.weight.index_select(0, rows), opacity, how)
    if not len(chosen):
        raise InputError("expected a scene that shows in its training views, found none of its Gaussians in any; train it longer")
    columns["raw_opacity"] = torch.logit(opacity.clamp(LEAST_ALPHA, MOST_ALPHA))
    rows, columns = rows[chosen], {name: value.index_select(0, chosen) for name, value in columns.items()}
    degree = how.sh_degree
    if isinstance(scene, GaussianScene):  # nothing but colours depends on the camera
        degree = min(degree, scene.config.sh_degree)
        columns = {name: scene.table.params[name].detach().index_select(0, rows) for name in columns}
    sh = fit_harmonics(draws, step, rows, sums, columns["means"], degree, cameras, rasterize, tell)
    columns |= {"sh_dc": sh[:, 0].contiguous(), "sh_rest": sh[:, 1:].contiguous()}
    del sums, sh
    first = explicit(columns, scene.extent)
    if not how.refine.iterations:
        return Baked(first, first, found)
    second = explicit({name: value.clone() for name, value in columns.items()}, scene.extent)
    refine(second, draws, step, views, torch.tensor(capture.background), rasterize, how.refine, how.seed, tell)
    return Baked(drawable(second), first, found)


def kept(weight: Tensor, opacity: Tensor, how: Bake) -> Tensor:
    """Which Gaussians [k] int64, ascending, of contributions `weight` [n] are kept: those that can be drawn, less what `how` leaves out."""
    order = weight.argsort(descending=True)
    sorted_ = weight.index_select(0, order).double()
    before = (sorted_.cumsum(0) - sorted_) / sorted_.sum().clamp_min(1e-12)
    chosen = (sorted_ > 0) & (opacity.index_select(0, order) >= LEAST_ALPHA)
    if how.prune > 0:
        chosen &= before < 1 - how.prune
    out = order[chosen]
    return (out[: how.max_gaussians] if how.max_gaussians else out).sort().values


def closed_form(sums: Sums, rows: Tensor) -> dict[str, Tensor]:
    """Means over the views, weighted by contribution, of the slots `rows` [n]: columns of explicit Gaussians but opacity and harmonics."""
    weight = sums.weight.index_select(0, rows)[:, None]
    return {
        "means": sums.means.index_select(0, rows) / weight,
        "log_scales": sums.log_scales.index_select(0, rows) / weight,
        "quats": functional.normalize(sums.quats.index_select(0, rows), dim=1),
    }


def explicit(columns: dict[str, Tensor], extent: float) -> GaussianScene:
    """A scene of explicit Gaussians of these columns, all of whose harmonics are in use from step 3 on."""
    degree = round((columns["sh_rest"].shape[1] + 1) ** 0.5) - 1
    return GaussianScene(Explicit(sh_degree=degree, sh_ramp=1), Table(columns, {}), extent)


@torch.no_grad()
def drawable(scene: GaussianScene) -> GaussianScene:
    """The scene without Gaussians so faint that they are drawn nowhere."""
    p = scene.table.params
    rows = (p["raw_opacity"].sigmoid() >= LEAST_ALPHA).nonzero().squeeze(1)
    return explicit({name: value.detach().index_select(0, rows) for name, value in p.items()}, scene.extent)
