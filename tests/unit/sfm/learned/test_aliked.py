"""ALIKED against a form that enlarges all layers, and that follows the paper word by word."""

import torch
from torch import Tensor
from torch.nn import functional

from scene_experts.sfm.learned.aliked import DIM, PLACES, Aliked, PictureFeatures, tensor_shapes
from support.learned import random_tensors

NETWORK = Aliked(random_tensors(tensor_shapes()))
PICTURE = torch.rand(3, 96, 128, generator=torch.Generator().manual_seed(3))


def enlarge(features: PictureFeatures) -> Tensor:
    """The joined features at the size of the picture [DIM, H, W], not normalised."""
    parts = [functional.interpolate(x[None], features.size, mode="bilinear", align_corners=True)[0] for x in features.levels]
    return torch.cat(parts)


def test_shapes_of_the_layers_and_the_number_of_weights():
    features, scores = NETWORK.look(PICTURE)
    assert [tuple(x.shape) for x in features.levels] == [(32, 96, 128), (32, 48, 64), (32, 12, 16), (32, 3, 4)]
    assert scores.shape == (96, 128) and scores.min() > 0 and scores.max() < 1
    trained = [shape for name, shape in tensor_shapes().items() if "running" not in name and "num_batches" not in name]
    assert abs(sum(torch.Size(shape).numel() for shape in trained) - 677_000) < 2_000  # 0.677 million, as the paper says


def test_scores_are_those_of_the_joined_features():
    features, scores = NETWORK.look(PICTURE)
    x = enlarge(features)[None]
    for i, padding in ((0, 0), (2, 1), (4, 1), (6, 1)):
        x = functional.conv2d(functional.selu(x) if i else x, NETWORK.tensors[f"score_head.{i}.weight"], padding=padding)
    assert torch.allclose(scores, x[0, 0].sigmoid(), atol=1e-5)


def test_features_are_looked_up_as_if_all_were_enlarged():
    features, _ = NETWORK.look(PICTURE)
    whole = functional.normalize(enlarge(features), dim=0)
    pixels = torch.tensor([[0.0, 0.0], [127.0, 95.0], [31.0, 64.0], [5.0, 90.0]])
    expected = torch.stack([whole[:, int(y), int(x)] for x, y in pixels], dim=1)
    assert torch.allclose(features.at_pixels(pixels), expected, atol=1e-5)
    place = torch.tensor([[10.25, 20.5]])
    around = [(10, 20, 0.75 * 0.5), (11, 20, 0.25 * 0.5), (10, 21, 0.75 * 0.5), (11, 21, 0.25 * 0.5)]
    assert torch.allclose(features.at(place)[:, 0], sum(share * whole[:, y, x] for x, y, share in around), atol=1e-5)
    assert not features.at(torch.tensor([[-2.0, 5.0], [500.0, 5.0]])).any()


def test_a_descriptor_is_the_sum_over_its_places():
    features, _ = NETWORK.look(PICTURE)
    whole, t = functional.normalize(enlarge(features), dim=0), NETWORK.tensors
    places = torch.tensor([[40.3, 30.8], [60.0, 50.0]])
    found = NETWORK.describe(features, places)
    for place, descriptor in zip(places, found, strict=True):
        x, y = (int(v) for v in place)
        patch = whole[None, :, y - 1 : y + 2, x - 1 : x + 2]
        hidden = functional.selu(functional.conv2d(patch, t["desc_head.offset_conv.0.weight"], t["desc_head.offset_conv.0.bias"]))
        offsets = functional.conv2d(hidden, t["desc_head.offset_conv.2.weight"], t["desc_head.offset_conv.2.bias"]).flatten()
        total = torch.zeros(DIM)
        for k in range(PLACES):
            there = features.at((place + torch.stack([offsets[k], offsets[PLACES + k]]))[None])[:, 0]
            total += functional.selu(t["desc_head.sf_conv.weight"][:, :, 0, 0] @ there) @ t["desc_head.agg_weights"][k]
        assert torch.allclose(descriptor, total / total.norm(), atol=1e-5)
    assert NETWORK.describe(features, torch.zeros(0, 2)).shape == (0, DIM)


def test_a_block_normalises_and_adds_its_input():
    x, t = torch.rand(16, 8, 8), NETWORK.tensors
    y = x[None]
    for half in (1, 2):
        y = functional.conv2d(y, t[f"block2.conv{half}.weight"], padding=1)
        mean, var, scale, shift = (
            t[f"block2.bn{half}.{part}"][:, None, None] for part in ("running_mean", "running_var", "weight", "bias")
        )
        y = (y - mean) / (var + 1e-5).sqrt() * scale + shift
        y = functional.selu(y) if half == 1 else y
    y = functional.selu(y + functional.conv2d(x[None], t["block2.downsample.weight"], t["block2.downsample.bias"]))
    assert torch.allclose(NETWORK.block(x, 2), y[0], atol=1e-4)
