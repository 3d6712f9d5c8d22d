"""Names of networks in memory and in files."""

import torch

from scene_experts.files.anchors.data import by_attribute, by_file_name


def test_names_there_and_back():
    networks = {
        "color": {"w1": torch.zeros(1), "router_w": torch.zeros(2), "router_b": torch.zeros(3), "middle.0.weight": torch.zeros(4)},
        "appearance": {"table": torch.zeros(5)},
    }
    flat = by_file_name(networks)
    assert list(flat) == [
        "color.experts.w1",
        "color.router.weight",
        "color.router.bias",
        "color.middle.0.weight",
        "appearance.table",
    ]
    assert by_attribute(flat) == networks
