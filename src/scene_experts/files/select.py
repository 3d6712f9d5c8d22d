"""Leaves Gaussians out of a file: those outside a box or a sphere, and floaters.

A floater is a Gaussian that no training photograph supports, but that other views may show:

* It covers less than LEAST pixels of every training photograph (its blending weights, summed), or
* it is faint (opacity below FAINT), large (angular size over LARGE times the median of all), and
  covers LEAST pixels of fewer than FEW training photographs.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera
from scene_experts.data.views import Capture, World
from scene_experts.files.formats.splats import Splats
from scene_experts.files.measure import Painter, Tell
from scene_experts.view.paths import analyse_cameras

LEAST = 0.3  # pixels
FAINT, LARGE, FEW = 0.1, 8.0, 4
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
HOW = "write sphere:RADIUS, sphere:X,Y,Z,RADIUS or box:X0,Y0,Z0,X1,Y1,Z1"


@dataclass(frozen=True)
class Crop:
    """A box or a sphere in the frame and units of the capture's poses."""

    numbers: tuple[float, ...]
    """One: a radius around the point that the cameras look at. Four: centre and radius of a sphere.
    Six: the lower and the upper corner of a box."""
    times: bool = False
    """The one radius counts in distances of the cameras from the point that they look at."""

    def contains(self, means: Tensor, capture: Capture) -> Tensor:
        """Return which of the positions [N, 3] (frame of the capture) are inside, [N] bool."""
        values = torch.tensor(self.numbers, dtype=torch.float64)
        xyz = means.double()
        if len(values) == 6:
            return ((xyz >= values[:3]) & (xyz <= values[3:])).all(1)
        centre, distance = find_subject(capture)
        if len(values) == 4:
            centre = values[:3]
        radius = float(values[-1]) * (distance if self.times else 1.0)
        return (xyz - centre).norm(dim=1) <= radius


def parse_crop(text: str) -> Crop:
    """Return the crop that `text` states. Raises InputError, which says how to write one."""
    kind, _, rest = text.partition(":")
    parts = [part.strip() for part in rest.split(",")]
    times = kind == "sphere" and len(parts) == 1 and parts[0].endswith("x")
    parts = [parts[0][:-1]] if times else parts
    counts = {"sphere": (1, 4), "box": (6,)}
    if kind not in counts or len(parts) not in counts[kind] or not all(re.fullmatch(_NUMBER, part) for part in parts):
        raise InputError(f"expected --crop as a sphere or a box, found '{text}'; {HOW}")
    numbers = tuple(map(float, parts))
    if (kind == "sphere" and numbers[-1] <= 0) or (kind == "box" and any(a >= b for a, b in zip(numbers[:3], numbers[3:]))):
        raise InputError(f"expected --crop with a positive size, found '{text}'; {HOW}")
    return Crop(numbers, times)


def find_subject(capture: Capture) -> tuple[Tensor, float]:
    """Return the point that the cameras look at [3] and their median distance from it, in the frame
    of the capture."""
    rig = analyse_cameras(capture)
    distance = float((rig.positions - rig.centre).norm(dim=1).median())
    return capture.world.to_input(rig.centre), distance / capture.world.scale


def crop(contents: Splats, how: Crop, capture: Capture, world: World) -> Splats:
    """Return the Gaussians inside a crop. world: the frame of `contents`. Raises InputError where
    none is inside."""
    own = contents.means if world == capture.world else capture.world.to_input(world.from_input(contents.means.double()))
    inside = how.contains(own, capture)
    if not bool(inside.any()):
        centre, distance = find_subject(capture)
        place = ", ".join(f"{v:.3g}" for v in centre.tolist())
        raise InputError(
            f"expected Gaussians inside --crop, found none; the cameras look at {place} from a distance of about {distance:.3g}"
        )
    return contents.rows(inside)


@torch.no_grad()
def find_floaters(contents: Splats, painter: Painter, cameras: Sequence[Camera], tell: Tell) -> Tensor:
    """Return which Gaussians are floaters, [N] bool. painter: draws `contents`; cameras: those of
    the training photographs."""
    from scene_experts.files.bake.observe import contributions

    most, photographs, size = (torch.zeros(len(contents)) for _ in range(3))
    for i, camera in enumerate(cameras):
        g = painter.gaussians(camera)
        covered = contributions(g, camera, painter.rasterize)
        most.index_copy_(0, g.source, torch.maximum(most.index_select(0, g.source), covered))
        photographs.index_add_(0, g.source, (covered >= LEAST).float())
        angular = g.scales.amax(1) / (g.means - camera.position).norm(dim=1).clamp_min(camera.near)
        size.index_copy_(0, g.source, torch.maximum(size.index_select(0, g.source), angular))
        tell("finding floaters", i + 1, len(cameras))
    seen = size > 0
    large = size > LARGE * (float(size[seen].median()) if bool(seen.any()) else 0.0)
    faint = contents.opacity_logit.sigmoid() < FAINT
    return (most < LEAST) | (faint & large & (photographs < FEW))
