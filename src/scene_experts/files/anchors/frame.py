"""From the trained world to the capture's own frame and back, for everything a file holds: trained = (input + shift) * scale.

The axes are kept, so offsets (factors of the scaling), features and viewing directions stay as they are; positions move, lengths scale, and
a network that takes the distance gets the scale folded into its first layer, so that a reader may feed it distances in the file's unit.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import torch
from torch import Tensor

from scene_experts.data.views import World

Network = dict[
    str, Tensor
]  # w1 [E, H, D], b1 [E, H], w2 [E, out, H], b2 [E, out] [, router_w [E, F], router_b [E]] [, middle.i.weight/bias]


def lattice_to_input(voxel: float, world: World) -> tuple[float, tuple[float, float, float]]:
    """Cell edge and origin of the trained lattice in the input frame: position = cell * edge + origin."""
    x, y, z = world.shift
    return voxel / world.scale, (-x, -y, -z)


def cell_positions(cells: Tensor, voxel: float, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor:
    """Positions [N, 3] float32 of lattice cells [N, 3] int64, computed in float64."""
    return (cells.double() * voxel + torch.tensor(origin, dtype=torch.float64)).float()


def cells_of(xyz: Tensor, voxel: float, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Tensor | None:
    """The lattice cells [N, 3] int64 of positions [N, 3], or None where the positions do not lie on that lattice.

    float32 positions are off by their rounding (relative to the largest coordinate), so a few hundred-thousandths of that are allowed.
    """
    place = (xyz.double() - torch.tensor(origin, dtype=torch.float64)) / voxel
    cells = place.round()
    reach = float(xyz.double().abs().max()) / voxel if xyz.numel() else 0.0
    off = float((place - cells).abs().max()) if xyz.numel() else 0.0
    return cells.to(torch.int64) if off <= min(0.25, 1e-3 + 4e-7 * reach) else None


def recover_voxel(xyz: Tensor) -> float | None:
    """The edge of the lattice (origin 0) on which positions [N, 3] lie, where files do not say it; None where none is found.

    The least gap between the different values of an axis is nearly always one cell; it is then fitted to all positions and checked.
    """
    guesses = []
    for axis in range(3):
        values = xyz[:, axis].double().unique()
        gaps = values.diff()
        gaps = gaps[gaps > 4e-6 * float(values.abs().max())] if len(values) > 1 else gaps
        guesses += [float(gaps.min())] if len(gaps) else []
    if not guesses:
        return None
    edge, flat = min(guesses), xyz.double().flatten()
    for reach in flat.abs().sort().values[torch.linspace(0, len(flat) - 1, 32).long()].tolist():  # near ones first: their cells are sure
        near = flat[flat.abs() <= reach]
        cells = (near / edge).round()
        if bool(cells.any()):
            edge = float((near * cells).sum() / (cells * cells).sum())
    return edge if cells_of(xyz, edge) is not None else None


def anchors_to_input(anchors: dict[str, Tensor], world: World) -> dict[str, Tensor]:
    """Anchors in the input frame and unit: xyz and log_scaling change, the other columns are passed on."""
    return anchors | {
        "xyz": world.to_input(anchors["xyz"].double()).float(),
        "log_scaling": (anchors["log_scaling"].double() - math.log(world.scale)).float(),
    }


def anchors_from_input(anchors: dict[str, Tensor], world: World) -> dict[str, Tensor]:
    """The inverse of `anchors_to_input`."""
    return anchors | {
        "xyz": world.from_input(anchors["xyz"].double()).float(),
        "log_scaling": (anchors["log_scaling"].double() + math.log(world.scale)).float(),
    }


def networks_to_input(networks: dict[str, Network], add_dist: Iterable[str], scale: float, features: int) -> dict[str, Network]:
    """Networks that take distances in the input unit: w1's distance column (after the feature and 3 of direction) times `scale`.

    add_dist: attributes whose network sees the distance; features: F.
    """
    out = dict(networks)
    for attribute in add_dist:
        w1 = networks[attribute]["w1"].clone()
        w1[:, :, features + 3] = w1[:, :, features + 3] * scale
        out[attribute] = networks[attribute] | {"w1": w1}
    return out


def networks_from_input(networks: dict[str, Network], add_dist: Iterable[str], scale: float, features: int) -> dict[str, Network]:
    """The inverse of `networks_to_input` (to rounding)."""
    return networks_to_input(networks, add_dist, 1.0 / scale, features)
