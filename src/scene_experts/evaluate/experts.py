"""How the experts share a scene: the share of each expert in numbers (Figure 3 of the MoE-GS paper)
and in pictures (Figure 5)."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.types import Camera, Decoded, Gaussians, Mode, Routing
from scene_experts.evaluate import pictures

if TYPE_CHECKING:
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

WIDEST = 480  # px; largest width of one picture in a strip that an evaluation writes


class Routed(Protocol):
    """A scene with routing. Routing does not depend on the camera."""

    def routing(self, step: int) -> dict[str, Routing]: ...


@dataclass(frozen=True)
class Shares:
    """The shares of the E experts of one attribute over all N rows, with E values in each list."""

    share: list[float] | None  # assignments / (N k), sums to 1; None if every row uses all experts
    per_anchor: list[float] | None  # assignments / N, sums to k; None if every row uses all experts
    first: list[float]  # fraction of rows whose largest gate belongs to the expert, sums to 1
    mean_gate: list[float]  # sums to 1
    entropy: float  # mean over rows of -sum_i g_i ln g_i / ln E: 1 = all experts equal, 0 = one expert alone
    k: int | None  # experts per row; None: all


def measure_shares(routing: Routing) -> Shares:
    """Return the shares of the experts of one attribute. They are zero for a scene without rows."""
    n, experts = routing.gates.shape
    gates = routing.gates.double()
    count = max(n, 1)
    first = torch.bincount(gates.argmax(dim=1), minlength=experts).double() / count
    entropy = float(torch.special.entr(gates).sum()) / count / math.log(experts) if experts > 1 else 0.0
    assigned, k = None, None
    if routing.chosen is not None:
        k = routing.chosen.shape[1]
        assigned = torch.bincount(routing.chosen.reshape(-1), minlength=experts).double() / count
    return Shares(
        share=None if assigned is None or k is None else (assigned / k).tolist(),
        per_anchor=None if assigned is None else assigned.tolist(),
        first=first.tolist(),
        mean_gate=(gates.sum(0) / count).tolist(),
        entropy=entropy,
        k=k,
    )


@torch.no_grad()
def measure_scene_shares(scene: Routed, step: int) -> dict[str, Shares]:
    """Return the shares over all rows of a scene, by attribute. The result is empty for a scene
    without experts."""
    return {attribute: measure_shares(routing) for attribute, routing in scene.routing(step).items()}


def select_gaussians(gaussians: Gaussians, mask: Tensor) -> Gaussians:
    """Return the Gaussians for which `mask` [M] bool is true, in order."""
    rows = mask.nonzero().squeeze(1)
    return replace(gaussians, **{name: value.index_select(0, rows) for name, value in vars(gaussians).items()})


def assign_gaussians(decoded: Decoded, attribute: str, K: int) -> Tensor:
    """Return a mask [M, E] bool: which experts of `attribute` the row of each Gaussian is routed
    to.

    While every row uses all experts, a Gaussian is assigned to the expert with the largest gate
    only.
    """
    routing = decoded.routing[attribute]
    experts = routing.gates.shape[1]
    chosen = routing.gates.argmax(1, keepdim=True) if routing.chosen is None else routing.chosen
    by_row = torch.zeros(len(decoded.rows), experts, dtype=torch.bool, device=chosen.device).scatter_(1, chosen, True)
    place = torch.searchsorted(decoded.rows, torch.div(decoded.gaussians.source, K, rounding_mode="floor"))  # rows are sorted
    return by_row.index_select(0, place)


@torch.no_grad()
def draw_experts(
    scene: Scene, camera: Camera, step: int, rasterize: Rasterizer, background: Tensor, attribute: str = "color"
) -> tuple[Tensor, list[Tensor]]:
    """Draw the scene [H, W, 3] in [0, 1], and once for each expert of `attribute` the Gaussians of
    the rows routed to it.

    With Top-2 routing every row is in two of the pictures. Raises KeyError if the attribute has no
    experts.
    """
    decoded = scene(camera, step, Mode.DRAW, rasterize.visible)
    mask = assign_gaussians(decoded, attribute, scene.K)
    draw = lambda gaussians: rasterize(gaussians, camera, background).image.clamp(0, 1)  # noqa: E731
    return draw(decoded.gaussians), [draw(select_gaussians(decoded.gaussians, mask[:, e])) for e in range(mask.shape[1])]


def draw_expert_strip(
    scene: Scene,
    camera: Camera,
    step: int,
    rasterize: Rasterizer,
    background: Tensor,
    attribute: str = "color",
    widest: int | None = None,
) -> np.ndarray:
    """Return the pictures of `draw_experts` in a row with captions, uint8 [H', W', 3].

    widest: Largest width of each picture in px. None keeps the width of the camera.
    """
    whole, each = draw_experts(scene, camera, step, rasterize, background, attribute)
    parts = [pictures.to_8bit(picture) for picture in (whole, *each)]
    captions = [f"all {attribute} experts", *(f"expert {i + 1}" for i in range(len(each)))]
    return pictures.compose_row(parts if widest is None else [pictures.limit_width(part, widest) for part in parts], captions)


@torch.no_grad()
def write_expert_strips(folder: Path, scene: Scene, camera: Camera, step: int, rasterize: Rasterizer, background: Tensor) -> None:
    """Write FOLDER/experts/<attribute>.png, the strip of one view, for each attribute whose
    Gaussians the experts share at `step`."""
    for attribute in scene(camera, step, Mode.DRAW, rasterize.visible).routing:
        sheet = draw_expert_strip(scene, camera, step, rasterize, background, attribute, WIDEST)
        pictures.write_picture(folder / "experts" / f"{attribute}.png", sheet)
