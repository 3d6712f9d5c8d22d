""".splat: 32 bytes a Gaussian, largest first, within the quantum of a byte."""

import struct

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.files.formats.splat import read, write
from scene_experts.files.formats.splats import Splats
from support.messages import naming
from support.splat_quanta import check, scene


@given(st.integers(0, 200), st.integers(0, 3), st.integers(0, 99), st.sampled_from([1e-3, 1.0, 1e4]))
@settings(max_examples=20, deadline=None)
def test_round_trip_within_the_quantum(tmp_path_factory, n, degree, seed, size):
    path = tmp_path_factory.mktemp("splat") / "a.splat"
    s = scene(n, degree, seed, size)
    write(path, s, {})
    assert path.stat().st_size == 32 * n
    check("splat", read(path), s)


def test_the_layout(tmp_path):
    sh = torch.tensor([[[0.5 / 0.28209479177387814, 0.0, -9.0]]])
    s = Splats(torch.tensor([[1.0, 2, 3]]), torch.log(torch.tensor([[0.5, 1, 2]])), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1), sh)
    write(tmp_path / "a.splat", s, {})
    row = struct.unpack("<6f8B", (tmp_path / "a.splat").read_bytes())
    assert row[:6] == pytest.approx((1, 2, 3, 0.5, 1, 2)) and row[6:] == (255, 128, 0, 128, 255, 128, 128, 128)


def test_damaged_files(tmp_path):
    path = tmp_path / "a.splat"
    write(path, scene(10), {})
    data = path.read_bytes()
    path.write_bytes(data[:-1])
    with pytest.raises(InputError, match=naming(319, 32)):
        read(path)
    path.write_bytes(struct.pack("<f", float("nan")) + data[4:])
    with pytest.raises(InputError, match=naming("a.splat")):
        read(path)
