"""The controls of the page."""

import numpy as np
import pytest
import torch

from scene_experts.files.select import parse_crop
from scene_experts.training.events import Finished, Stepped

pytest.importorskip("viser")


def test_one_expert_alone(viewer):
    for switch in viewer.panel.switches:
        switch.value = False
    viewer.panel.switches[2].value = True
    assert viewer.panel.read_look().only == (2,)


def test_cameras_and_anchors_are_shown_and_hidden(viewer):
    viewer.panel.show_frusta(True)
    viewer.panel.show_rows(True)
    assert (
        viewer.server.scene.get_handle_by_name("/anchors") is not None and viewer.server.scene.get_handle_by_name("/cameras/0") is not None
    )
    viewer.panel.show_frusta(False)
    viewer.panel.show_rows(False)
    assert viewer.server.scene.get_handle_by_name("/anchors") is None and viewer.server.scene.get_handle_by_name("/cameras/0") is None


def test_the_crop_box_is_that_of_export(viewer):
    panel, world = viewer.panel, viewer.capture.world
    assert not world.identity
    panel.crop.value = True
    low, high = panel.bounds[0].value
    panel.bounds[0].value = (low, (low + high) / 2)
    assert panel.crop_text.content == panel.crop_words()
    box = parse_crop(panel.crop_text.content.strip("`").removeprefix("--crop "))
    xyz = panel.current()[0].positions.double()
    lower, upper = map(torch.tensor, panel.read_look().box)
    drawn = ((xyz >= lower) & (xyz <= upper)).all(1)
    assert torch.equal(box.contains(world.to_input(xyz), viewer.capture), drawn) and 0 < int(drawn.sum()) < len(xyz)


def test_curves_follow_a_training(viewer):
    viewer.panel.add_training_controls()
    for step in (10, 20):
        viewer.panel.curve_time = 0.0
        viewer.panel.report_picture(0.1, viewer.capture.views[0].camera)  # a client moves
        viewer.panel.follow(Stepped(step, {"l1": 0.1, "dssim": 0.2}, 20.0 + step, 100, 50, 400, 0.5, 1.0, {}))
    assert viewer.panel.curves["psnr"] == [30.0, 40.0] and viewer.panel.curves["loss"] == [pytest.approx(0.3)] * 2
    plots = dict(viewer.panel.charts)
    assert np.array_equal(plots["psnr"].data[0], [10, 20]) and "iteration 20" in viewer.panel.status.content
    viewer.panel.follow(Finished(30, 9.0))
    assert "30" in viewer.panel.status.content and not viewer.panel.is_paused()


def test_the_background_is_the_captures(viewer, capture):
    assert torch.allclose(torch.tensor(viewer.panel.read_background()), torch.tensor(capture.background), atol=0.01)
