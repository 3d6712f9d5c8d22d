"""The colour behind the scene.

What no training photograph shows stays empty, and there the background is seen. Behind a capture of
few photographs the mean colour of the photographs is nearer to what is there than black
(results/default.md).
"""

from __future__ import annotations

from dataclasses import replace

from scene_experts.data.capture import Capture
from scene_experts.data.views import Vector
from scene_experts.training.config import RunConfig

MOST = 50  # photographs whose colours are counted, evenly spread


def with_background(config: RunConfig, capture: Capture) -> tuple[RunConfig, Capture]:
    """Return the configuration and the capture with the background that the recipe asks for.

    With `train.mean_background` it is the mean colour, unless `data.background` names one or the
    photographs are transparent or have masks: then what is left out is known to be background.
    """
    colour = config.data.background
    if colour is None and config.train.mean_background and capture.alpha_over is None:
        colour = mean_colour(capture)
    if colour is None:
        return config, capture
    return replace(config, data=replace(config.data, background=colour)), replace(capture, background=colour)


def mean_colour(capture: Capture) -> Vector | None:
    """Return the mean RGB in [0, 1] of up to MOST training photographs, rounded to thousandths, so
    that all processors return the same; None if one of them has a mask.

    Every photograph has the same weight.
    """
    count = min(MOST, len(capture.train))
    means = []
    for index in (capture.train[i * len(capture.train) // count] for i in range(count)):
        frame = capture.frame(index)
        if frame.mask is not None:
            return None
        means.append(frame.rgb.double().mean(dim=(0, 1)) / 255)
    r, g, b = (round(sum(float(mean[c]) for mean in means) / count, 3) for c in range(3))
    return r, g, b
