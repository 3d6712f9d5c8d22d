"""Rows of training photographs: found by their cameras, and again in a checkpoint."""

from dataclasses import replace

import torch
from torch import nn

from scene_experts.scene.per_view import PerView
from support.scenes import CAMERA


class Weights(PerView):
    group, learned, buffers_kept = "weights", "values", ("ids",)

    def __init__(self, cameras):
        super().__init__()
        self.values = nn.Parameter(torch.arange(float(len(cameras))))
        self.set_cameras(cameras)


def test_rows_come_back_from_a_checkpoint_with_their_cameras():
    made = Weights([replace(CAMERA, id=id) for id in (7, 2)])
    assert set(made.tensors()) == {"weights.values", "weights.ids"}
    again = Weights.restore(made.tensors())
    assert again is not None and again.row == {7: 0, 2: 1} and torch.equal(again.values, made.values)
    assert again.values is not made.values and again.values.requires_grad
    assert Weights.restore({"other.values": made.values}) is None
