import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.scene.anchors.mlp import ACTIVATIONS, MLP, Plain, linear_init
from support.messages import naming


@pytest.mark.parametrize("attribute", ["opacity", "cov", "color"])
def test_equals_a_torch_sequential(attribute):
    torch.manual_seed(0)
    mlp = MLP(attribute, 35, 32, 20)
    layers = torch.nn.Sequential(torch.nn.Linear(35, 32), torch.nn.ReLU(), torch.nn.Linear(32, 20))
    tensors = {"0.weight": mlp.w1, "0.bias": mlp.b1, "2.weight": mlp.w2, "2.bias": mlp.b2}
    layers.load_state_dict({name: value[0].detach() for name, value in tensors.items()})
    x = torch.randn(7, 35)
    y, routing = mlp(x, x[:, :32], 1)
    torch.testing.assert_close(y, ACTIVATIONS[attribute](layers(x)))
    assert routing is None and mlp.route(x[:, :32], 1) is None


def test_depth_adds_square_layers():
    deep = Plain(depth=5).build("color", 35, 32, 30, 32)
    assert len(deep.middle) == 3 and deep.weights(1).middle_w.shape[:2] == (1, 3)
    assert sum(p.numel() for p in deep.parameters()) == 2142 + 3 * (32 * 32 + 32)
    assert deep(torch.randn(4, 35), torch.randn(4, 32), 1)[0].shape == (4, 30)
    assert Plain().build("color", 35, 32, 30, 32).weights(1).k is None
    with pytest.raises(InputError, match=naming("--scene.decoder.depth", 2, 1)):
        check_fields(Plain(depth=1), "scene.decoder")


def test_initial_values_are_uniform_within_the_fan_in_bound():
    torch.manual_seed(0)
    p = linear_init((200, 16), 16)
    assert p.abs().max() <= 0.25 and p.abs().max() > 0.24 and abs(float(p.detach().mean())) < 0.01
