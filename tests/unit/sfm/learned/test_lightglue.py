"""LightGlue against its equations, number by number."""

import math

import torch

from scene_experts.sfm.learned.lightglue import (
    HEADS,
    INPUT,
    LEAST,
    WIDTH,
    Keypoints,
    LightGlue,
    State,
    attend,
    rotate,
    split,
    tensor_shapes,
)
from support.learned import random_tensors

TENSORS = random_tensors(tensor_shapes())


def keypoints(count: int, seed: int) -> Keypoints:
    gen = torch.Generator().manual_seed(seed)
    descriptors = torch.nn.functional.normalize(torch.randn(count, INPUT, generator=gen), dim=1)
    return Keypoints(torch.rand(count, 2, generator=gen) * torch.tensor([64.0, 48.0]), descriptors, (64, 48))


def test_the_number_of_weights():
    count = sum(torch.Size(shape).numel() for shape in tensor_shapes().values())
    assert 11.8e6 < count < 12.0e6  # 11.9 million


def test_places_are_relative_to_the_centre():
    points = Keypoints(torch.tensor([[32.0, 24.0], [64.0, 48.0], [0.0, 24.0]]), torch.zeros(3, INPUT), (64, 48))
    assert torch.equal(points.relative(), torch.tensor([[0.0, 0.0], [1.0, 0.75], [-1.0, 0.0]]))


def test_attention_is_a_weighted_mean():
    gen = torch.Generator().manual_seed(1)
    q, k, v = (torch.randn(HEADS, count, 8, generator=gen) for count in (3, 5, 5))
    found = attend(q, k, v).reshape(3, HEADS, 8)
    for head in range(HEADS):
        for i in range(3):
            weights = [math.exp(float(q[head, i] @ k[head, j]) / math.sqrt(8)) for j in range(5)]
            expected = sum(w * v[head, j] for j, w in enumerate(weights)) / sum(weights)
            assert torch.allclose(found[i, head], expected, atol=1e-5)
    assert torch.equal(split(torch.arange(2.0 * WIDTH).reshape(2, WIDTH))[1, 0], torch.arange(64.0, 128.0))


def test_products_of_rotated_vectors_depend_on_the_difference_of_positions():
    gen = torch.Generator().manual_seed(2)
    q, k, wave = torch.randn(1, 1, 8, generator=gen), torch.randn(1, 1, 8, generator=gen), torch.randn(4, 2, generator=gen)

    def turned(x, place):
        angles = (torch.tensor([place]) @ wave.T).repeat_interleave(2, dim=1)
        return rotate(x, angles.cos(), angles.sin()).flatten()

    one = turned(q, (0.1, 0.2)) @ turned(k, (0.4, -0.3))
    other = turned(q, (0.6, 0.9)) @ turned(k, (0.9, 0.4))
    assert torch.allclose(one, other, atol=1e-5) and torch.allclose(turned(q, (0.3, 0.3)).norm(), q.norm(), atol=1e-5)


def test_matches_are_the_most_probable_partners_of_each_other():
    matcher = LightGlue(TENSORS)
    gen = torch.Generator().manual_seed(3)
    a, b = (State(torch.arange(10, 10 + n), torch.randn(n, WIDTH, generator=gen), torch.zeros(0), torch.zeros(0)) for n in (4, 6))
    t = {name.removeprefix("log_assignment.2."): value for name, value in TENSORS.items() if name.startswith("log_assignment.2.")}
    pa, pb = (s.x @ t["final_proj.weight"].T + t["final_proj.bias"] for s in (a, b))
    ma, mb = ((s.x @ t["matchability.weight"].T + t["matchability.bias"])[:, 0].sigmoid() for s in (a, b))
    s = pa @ pb.T / math.sqrt(WIDTH)
    p = torch.zeros(4, 6)
    for i in range(4):
        for j in range(6):
            p[i, j] = s[i, j].exp() ** 2 / (s[i].exp().sum() * s[:, j].exp().sum()) * ma[i] * mb[j]
    expected = [[10 + i, 10 + j] for i in range(4) for j in range(6) if p[i, j] == p[i].max() == p[:, j].max() and p[i, j] > LEAST]
    pairs, probability = matcher.assign(a, b, 2)
    assert expected and pairs.tolist() == expected
    assert torch.allclose(probability, torch.stack([p[i - 10, j - 10] for i, j in expected]), atol=1e-4)


def test_a_layer_changes_with_both_photographs():
    matcher = LightGlue(TENSORS)
    a, b = matcher.begin(keypoints(4, 1)), matcher.begin(keypoints(5, 2))
    one, other = matcher.exchange(a, b, 0)
    assert one.x.shape == (4, WIDTH) and other.x.shape == (5, WIDTH) and not torch.allclose(one.x, a.x)
    moved = matcher.exchange(a, matcher.begin(keypoints(5, 3)), 0)[0]
    assert not torch.allclose(moved.x, one.x)
    swapped = matcher.exchange(b, a, 0)[1]  # cross-attention is the same in both directions
    assert torch.allclose(swapped.x, one.x, atol=1e-5)


def test_settled_keypoints_without_partner_are_left_out():
    tensors = {**TENSORS, "log_assignment.0.matchability.bias": torch.tensor([-90.0])}
    matcher = LightGlue(tensors)
    state = matcher.begin(keypoints(6, 1))
    sure = torch.tensor([0.99, 0.1, 0.99, 0.99, 0.1, 0.1])
    left = matcher.leave_out(state, sure, 0.9, 0)
    assert left.index.tolist() == [1, 4, 5] and torch.equal(left.cos, state.cos[[1, 4, 5]])


def test_it_stops_when_all_are_settled_and_nothing_matches_nothing(monkeypatch):
    settled = {name: torch.full_like(value, 90.0) for name, value in TENSORS.items() if name.endswith("token.0.bias")}
    layers = []
    exchange = LightGlue.exchange
    monkeypatch.setattr(LightGlue, "exchange", lambda self, a, b, layer: (layers.append(layer), exchange(self, a, b, layer))[1])
    LightGlue({**TENSORS, **settled}).match(keypoints(5, 1), keypoints(6, 2))
    assert layers == [0]
    layers.clear()
    LightGlue({**TENSORS, **settled}, adaptive=False).match(keypoints(5, 1), keypoints(6, 2))
    assert layers == list(range(9))
    assert LightGlue(TENSORS).match(keypoints(0, 1), keypoints(6, 2))[0].shape == (0, 2)
