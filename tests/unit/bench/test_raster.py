"""Figures of the rasteriser."""

from dataclasses import replace

import pytest

from scene_experts.bench import machine, peer, raster
from scene_experts.native import library as native


def test_ratios_and_the_bound_follow_from_the_times():
    here = machine.describe(1)
    if here.level is None or peer.load(here.level) is None:
        pytest.skip("no compiled library")
    here = replace(here, clock_hz=1e9, multiply_adds=1e9)
    scene = raster.make_picture(500, 64, 48)
    found = {(f.name, getattr(f, "peer", "")): f for f in raster.measure(scene, here, 0.0)}
    both = found[f"{here.level}, forward + backward", raster.REFERENCE].value
    forward, backward = (found[f"{here.level}, {part}", ""].value for part in ("forward", "backward"))
    assert both == pytest.approx(forward + backward)
    assert found[f"{here.level}, forward + backward", peer.NAME].ratio > 1
    cycles, share = found["core cycles per blended pair", ""], found["share of the arithmetic bound", ""]
    assert share.value == pytest.approx(100 * (raster.FORWARD + raster.BACKWARD) / cycles.value)  # at a multiply-add a cycle
    assert native.load() is not None and "500 Gaussians, 64x48" in str(scene)
