"""The near plane: how close to a camera Gaussians are drawn.

What a training puts much closer to its cameras than the nearest point that their photographs show is
mostly fog, and stands before cameras that have no photograph (results/default.md).
"""

from __future__ import annotations

from dataclasses import replace

from scene_experts.data.capture import Capture
from scene_experts.data.projection import project
from scene_experts.training.config import RunConfig

SHARE = 0.01  # of a view's points that may be nearer than its nearest depth: some are wrong
FEWEST = 20  # points of a view that tell its nearest depth


def with_near_plane(config: RunConfig, capture: Capture) -> tuple[RunConfig, Capture]:
    """Return the configuration and the capture with the near plane that the recipe asks for.

    It lies at `train.near_share` of the least depth that photographs show, never nearer than the
    default. `data.near` has the last word, also for a capture that was loaded without it. A capture
    without points of its own keeps the default.
    """
    share, near = config.train.near_share, config.data.near
    if near is None:
        if share == 0 or (nearest := find_nearest(capture)) is None:
            return config, capture
        near = float(f"{share * nearest:.3g}")  # the same on all processors
        if near <= max(view.camera.near for view in capture.views):
            return config, capture
    if all(view.camera.near == near for view in capture.views):
        return replace(config, data=replace(config.data, near=near)), capture
    views = tuple(replace(view, camera=replace(view.camera, near=near)) for view in capture.views)
    return replace(config, data=replace(config.data, near=near)), replace(capture, views=views)


def find_nearest(capture: Capture) -> float | None:
    """Return the least depth, in trained units, at which a training view shows a point of the
    capture, but for the nearest hundredth of its points; None if no view shows enough points."""
    if capture.points is None or capture.random_points:
        return None
    found = []
    for view in (capture.views[i] for i in capture.train):
        u, v, z = project(capture.points.xyz, view.camera)
        depth = z[(z > 0) & (u >= 0) & (u <= view.camera.width) & (v >= 0) & (v <= view.camera.height)]
        if len(depth) >= FEWEST:
            found.append(float(depth.kthvalue(1 + int(SHARE * len(depth))).values))
    return min(found, default=None)
