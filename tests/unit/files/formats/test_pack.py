"""What packed formats share, against the definitions of rotation, covariance and harmonics."""

import itertools
from pathlib import Path

import numpy as np
import pytest
import torch

from scene_experts.core.reading.budget import SPZ, Damaged
from scene_experts.core.reading.source import Source
from scene_experts.files.formats import pack
from scene_experts.files.formats.pack import morton_order, tensor
from scene_experts.geometry.rotation import covariance
from scene_experts.geometry.sh import sh_to_rgb
from support.messages import naming
from support.splat_quanta import scene


@pytest.mark.parametrize(("axis", "signs"), [("x", (1.0, -1, -1)), ("z", (-1.0, -1, 1))])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_turned_frame_shows_the_same_scene(axis, signs, degree):
    s = scene(40, degree)
    t = pack.turn(s, axis)
    turn, look = torch.diag(torch.tensor(signs)), torch.randn(40, 3)
    torch.testing.assert_close(t.means, s.means @ turn)
    unit = lambda x: torch.nn.functional.normalize(x.quats, dim=1)  # noqa: E731
    ours = covariance(unit(s), s.log_scales.exp())
    torch.testing.assert_close(covariance(unit(t), t.log_scales.exp()), turn @ ours @ turn, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(sh_to_rgb(t.sh, look @ turn, degree), sh_to_rgb(s.sh, look, degree), rtol=1e-4, atol=1e-5)
    again = pack.turn(t, axis)
    assert all(torch.equal(getattr(again, name), getattr(s, name)) for name in ("means", "quats", "sh"))


@pytest.mark.parametrize("signs", list(itertools.product((1, -1), repeat=3)))
def test_flipped_axes_show_the_same_scene_also_in_a_mirror(signs):
    s = scene(40, 3)
    t = pack.flip(s, signs)
    axes, look = torch.diag(torch.tensor(signs).float()), torch.randn(40, 3)
    assert torch.equal(t.means, s.means @ axes)
    unit = lambda x: torch.nn.functional.normalize(x.quats, dim=1)  # noqa: E731
    ours = covariance(unit(s), s.log_scales.exp())
    torch.testing.assert_close(covariance(unit(t), t.log_scales.exp()), axes @ ours @ axes, rtol=1e-4, atol=1e-7)
    torch.testing.assert_close(sh_to_rgb(t.sh, look @ axes, 3), sh_to_rgb(s.sh, look, 3), rtol=1e-4, atol=1e-5)


def test_smallest_three_and_back():
    q = pack.unit_quats(scene(500))
    largest, rest = pack.smallest_three(q)
    assert (np.abs(rest) <= np.sqrt(0.5) + 1e-12).all()
    back = pack.from_smallest_three(largest, rest)
    assert np.abs(np.abs((back * q).sum(1)) - 1).max() < 1e-12
    zero = scene(2)
    zero.quats[0] = 0
    assert pack.unit_quats(zero)[0].tolist() == [1, 0, 0, 0]


def test_bytes_of_opacities_are_finite_logits():
    values = pack.byte_logits(np.arange(256))
    assert np.isfinite(values).all() and (np.diff(values) > 0).all()
    np.testing.assert_allclose(1 / (1 + np.exp(-values.astype(np.float64))), np.arange(256) / 255, atol=0.26 / 255)
    assert pack.to_bytes(np.array([-1, 0, 0.5, 1, 2.0])).tolist() == [0, 0, 128, 255, 255]


def test_sizes_that_cannot_be_honest():
    pack.check_count(Source(Path("a"), SPZ, 10), 10, 10_000)
    pack.check_count(Source(Path("a"), SPZ, 1 << 27), 1 << 20, 1 << 10)
    with pytest.raises(Damaged, match=naming("1,000,000,000")):
        pack.check_count(Source(Path("a"), SPZ, 1 << 40), 10**9, 1)
    with pytest.raises(Damaged, match=naming(100, "1,048,576")):
        pack.check_count(Source(Path("a"), SPZ, 100), 1 << 20, 1 << 10)


def test_a_permutation_of_near_neighbours():
    xyz = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * 100 - 30
    order = morton_order(xyz)
    assert order.sort().values.tolist() == list(range(4000))
    step = lambda rows: (rows[1:] - rows[:-1]).norm(dim=1).mean()  # noqa: E731
    assert step(xyz[order]) < 0.25 * step(xyz)


def test_none_one_and_equal_places():
    assert morton_order(torch.zeros(0, 3)).tolist() == [] and morton_order(torch.ones(1, 3)).tolist() == [0]
    assert morton_order(torch.ones(5, 3)).tolist() == [0, 1, 2, 3, 4]


@pytest.mark.filterwarnings("error")
def test_values_beyond_float32_become_infinite_without_a_warning():
    assert tensor(np.array([1e300, -1e300, 1.0])).tolist() == [np.inf, -np.inf, 1.0]
