"""What keeps anchors from learning their training views by heart: moved viewing positions and
dropped anchors.

The networks see the direction from the camera to an anchor, so with few photographs they can learn
another scene for each of them, and held-out views between these fall apart. With `view_jitter` s, a
training view is drawn from its camera, but decoded as seen from
    c' = c + s d n / sqrt(3),   n ~ N(0, I),
where d is the mean distance from c to the two nearest other training cameras. What one photograph
shows is then asked of all positions around it, and neighbouring photographs have to agree on the
positions between them. s is the root mean square of |c' - c| / d.

With `dropout` p, each anchor is left out of a training view with probability p (after DropGaussian,
Park et al., CVPR 2025).

With `few_views` m, both fall linearly to nothing from m to 2 m training views: with more
photographs, little is left to guess, and both cost sharpness.

With `few_fall` (a, b), both fall linearly to nothing from iteration a to b: the last iterations
train what is drawn afterwards, all anchors from where the cameras stand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.core.types import Camera
from scene_experts.geometry.neighbours import find_neighbours

NEAREST = 2  # neighbours whose mean distance is a camera's spacing: on a path, the ones before and behind


def find_spacings(cameras: Sequence[Camera]) -> dict[int, float]:
    """Return by id the mean distance from each camera to its two nearest others, world units; 0 for
    a single camera."""
    d2, _ = find_neighbours(torch.stack([camera.position.cpu() for camera in cameras]), NEAREST)
    means = d2.sqrt().mean(dim=1).tolist() if d2.shape[1] else [0.0] * len(cameras)
    return {camera.id: distance for camera, distance in zip(cameras, means, strict=True)}


def displace(camera: Camera, distance: float) -> Camera:
    """Return the camera at a random position around its own, with the same orientation.

    The displacement is Gaussian and isotropic. Its root mean square is `distance`, world units.
    """
    place = camera.world_to_cam.clone()
    moved = camera.position + torch.randn(3, dtype=place.dtype, device=place.device) * (distance / math.sqrt(3.0))
    place[:3, 3] = -(place[:3, :3] @ moved)
    made = replace(camera, world_to_cam=place)
    if place.is_cuda:  # known already; four kernels less
        made.__dict__["position"] = moved
    return made


def drop_anchors(rows: Tensor, share: float) -> Tensor:
    """Return the rows [A] without a random `share` of them."""
    return rows[keep_at_random(len(rows), share, rows.device)]


def keep_at_random(count: int, share: float, device: torch.device) -> Tensor:
    """Return [count] bool: false for a random `share` of them."""
    return torch.rand(count, device=device) >= share


def find_weight(few: int, views: int) -> float:
    """Return the factor of the dropout and the displacement with `views` training views: 1 up to
    `few` of them, 0 from 2 few on.

    It falls linearly between. With few = 0 it is 1 for any number of views.
    """
    return min(1.0, max(0.0, 2.0 - views / few)) if few else 1.0


def left_at(step: int, first: int, last: int) -> float:
    """Return the factor of the dropout and the displacement at an iteration: 1 up to `first`, 0 from
    `last` on, linear between. With last = 0 it is 1 at any iteration."""
    return min(1.0, max(0.0, (last - step) / max(last - first, 1))) if last else 1.0
