"""Standard Gaussians: shapes and values are checked."""

import dataclasses

import pytest
import torch

from scene_experts.core.errors import InputError
from support.messages import naming
from support.splats import splats


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_degree_length_and_rows(degree):
    s = splats(5, degree)
    assert s.degree == degree and len(s) == 5
    part = s.rows(torch.tensor([4, 0]))
    assert len(part) == 2 and torch.equal(part.sh[0], s.sh[4]) and torch.equal(part.quats[1], s.quats[0])
    assert len(s.rows(torch.zeros(5, dtype=torch.bool))) == 0
    assert s.up_to_degree(3) is s and s.up_to_degree(1).degree == min(degree, 1)
    assert torch.equal(s.up_to_degree(0).sh, s.sh[:, :1])


@pytest.mark.parametrize("name", ["means", "log_scales", "quats", "opacity_logit", "sh"])
def test_shapes_that_disagree(name):
    s = splats()
    with pytest.raises(InputError, match=name):
        dataclasses.replace(s, **{name: getattr(s, name)[:4]})
    with pytest.raises(InputError, match=naming("sh", 16)):
        dataclasses.replace(s, sh=s.sh[:, :5])


def test_values_that_are_not_finite_are_counted():
    s = splats(6)
    s.expect_finite("there")
    s.sh[2, 1, 0], s.sh[4, 0, 0] = float("nan"), float("inf")
    with pytest.raises(InputError, match=naming("sh", "there", 2)):
        s.expect_finite("there")
    splats(0).expect_finite("there")
