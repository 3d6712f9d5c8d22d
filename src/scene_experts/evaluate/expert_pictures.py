"""Pictures of single experts: the anchors that an expert decodes, drawn alone (what the MoE-GS paper's Figure 5 shows)."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.types import Camera, Decoded, Gaussians, Mode
from scene_experts.evaluate import pictures

if TYPE_CHECKING:
    from scene_experts.render import Rasterizer
    from scene_experts.scene import Scene

WIDEST = 480  # px of a picture in an evaluation's strip


def keep(gaussians: Gaussians, mask: Tensor) -> Gaussians:
    """The Gaussians where `mask` [M] (bool) is true, in order."""
    rows = mask.nonzero().squeeze(1)
    return replace(gaussians, **{name: value.index_select(0, rows) for name, value in vars(gaussians).items()})


def chosen_by(decoded: Decoded, attribute: str, K: int) -> Tensor:
    """[M, E] bool: whether an expert was chosen for the anchor of a Gaussian. While the mixture is dense: the largest gate alone."""
    routing = decoded.routing[attribute]
    experts = routing.gates.shape[1]
    chosen = routing.gates.argmax(1, keepdim=True) if routing.chosen is None else routing.chosen
    by_row = torch.zeros(len(decoded.rows), experts, dtype=torch.bool, device=chosen.device).scatter_(1, chosen, True)
    place = torch.searchsorted(decoded.rows, torch.div(decoded.gaussians.source, K, rounding_mode="floor"))  # rows come in order
    return by_row.index_select(0, place)


@torch.no_grad()
def alone(
    scene: Scene, camera: Camera, step: int, rasterize: Rasterizer, background: Tensor, attribute: str = "color"
) -> tuple[Tensor, list[Tensor]]:
    """The whole picture [H, W, 3] and one per expert of `attribute`, each of the Gaussians of anchors routed to it.

    With Top-2 every anchor is in two pictures. Raises KeyError where the attribute has no experts.
    """
    decoded = scene(camera, step, Mode.DRAW, rasterize.visible)
    mine = chosen_by(decoded, attribute, scene.K)
    draw = lambda gaussians: rasterize(gaussians, camera, background).image.clamp(0, 1)  # noqa: E731
    return draw(decoded.gaussians), [draw(keep(decoded.gaussians, mine[:, e])) for e in range(mine.shape[1])]


def strip(
    scene: Scene,
    camera: Camera,
    step: int,
    rasterize: Rasterizer,
    background: Tensor,
    attribute: str = "color",
    widest: int | None = None,
) -> np.ndarray:
    """The pictures of `alone` in a row under captions, uint8 [H', W', 3]; each at most `widest` px wide where that is given."""
    whole, each = alone(scene, camera, step, rasterize, background, attribute)
    parts = [pictures.to_8bit(picture) for picture in (whole, *each)]
    captions = [f"all {attribute} experts", *(f"expert {i + 1}" for i in range(len(each)))]
    return pictures.row(parts if widest is None else [pictures.narrowed(part, widest) for part in parts], captions)


def write(folder: Path, scene: Scene, camera: Camera, step: int, rasterize: Rasterizer, background: Tensor) -> None:
    """Write FOLDER/experts/<attribute>.png, the strip of one view, for each attribute that has experts; nothing where none has."""
    for attribute in scene.routing(step, 1):
        sheet = strip(scene, camera, step, rasterize, background, attribute, WIDEST)
        pictures.write(folder / "experts" / f"{attribute}.png", sheet)
