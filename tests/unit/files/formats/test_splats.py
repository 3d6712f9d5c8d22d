"""Standard Gaussians: shapes and values are checked."""

import dataclasses
import math
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.formats.splats import Splats, tell_degree
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


def test_infinite_values_that_mean_something_become_finite():
    s = splats(6)
    s.opacity_logit[1], s.opacity_logit[2], s.log_scales[3, 1] = float("inf"), float("-inf"), float("-inf")
    found = s.checked(Path("there"))
    assert len(found) == 6 and found.opacity_logit[1:3].tolist() == [20, -20] and found.opacity_logit.sigmoid()[1] == 1
    assert found.log_scales[3, 1] == pytest.approx(math.log(1e-30)) and torch.equal(found.log_scales[:3], s.log_scales[:3])
    s.opacity_logit[1:3] = torch.tensor([3e38, -3e38])  # the largest floats, which some programs write for infinity
    s.log_scales[3, 1] = -3e38
    assert torch.equal(s.checked(Path("there")).opacity_logit, found.opacity_logit) and s.checked(Path("there")).log_scales[3, 1] > -70
    plain = splats(6)
    assert torch.equal(plain.checked(Path("there")).opacity_logit, plain.opacity_logit)


@pytest.mark.parametrize(
    ("name", "value", "word"),
    [("opacity_logit", "nan", "NaN"), ("log_scales", "inf", "infinite"), ("sh", "-inf", "infinite"), ("quats", "nan", "NaN")],
)
def test_others_are_refused_with_what_they_are(name, value, word):
    s = splats(6)
    getattr(s, name).view(6, -1)[4, 0] = float(value)
    with pytest.raises(InputError, match=naming(name, "there", 1, word)):
        s.checked(Path("there"))


def test_a_few_that_are_not_finite_are_left_out_and_counted(caplog):
    s = splats(200)
    s.means[7, 1], s.log_scales[150, 0] = float("nan"), float("inf")
    found = s.checked(Path("there"))
    assert len(found) == 198 and "2 of 200" in caplog.text and "there" in caplog.text
    s.sh[3, 0, 0] = float("nan")
    with pytest.raises(InputError, match=naming("there", 1, "NaN")):
        s.checked(Path("there"))


def test_gaussians_without_a_rotation_are_left_out_and_counted(caplog):
    s = splats(6)
    s.quats[[0, 4]] = torch.tensor([0.0, 1e-20, 0, 0])
    found = s.checked(Path("there"))
    assert torch.equal(found.means, s.means[[1, 2, 3, 5]]) and "2 of 6" in caplog.text and "there" in caplog.text
    s.quats[:] = 0
    with pytest.raises(InputError, match=naming("there", 6)):
        s.checked(Path("there"))


def test_parts_are_joined_with_the_harmonics_that_all_have():
    a, b = splats(3, 2), splats(2, 1, seed=1)
    found = Splats.joined([a, b])
    assert len(found) == 5 and found.degree == 1 and torch.equal(found.sh[:3], a.sh[:, :4]) and torch.equal(found.quats[3:], b.quats)
    assert Splats.joined([a]) is a


def test_harmonics_above_the_third_degree_are_told(caplog):
    tell_degree(3)
    assert not caplog.text
    tell_degree(4)
    assert "degree 4" in caplog.text
