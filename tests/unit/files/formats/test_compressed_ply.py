"""Compressed PLY: within the quantum of each chunk's ranges, with its note, and damaged files in one sentence."""

import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from plyfile import PlyData

from scene_experts.core.errors import InputError
from scene_experts.files.formats.compressed_ply import read, write
from scene_experts.files.formats.ply import read_note
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import recognise
from support import foreign
from support.messages import naming
from support.splat_quanta import check, scene


@given(st.sampled_from([0, 1, 255, 256, 257, 600]), st.integers(0, 3), st.integers(0, 99), st.sampled_from([1e-3, 1.0, 1e4]))
@example(n=600, degree=1, seed=23, size=1e-3)  # a quaternion near (1, 1, 1, 1) / 2, where rounding has the largest effect
@settings(max_examples=25, deadline=None)
def test_round_trip_within_the_quantum(tmp_path_factory, n, degree, seed, size):
    path = tmp_path_factory.mktemp("ply") / "a.ply"
    s = scene(n, degree, seed, size)
    write(path, s, {})
    check("compressed-ply", read(path), s)


def test_a_plain_ply_reader_sees_its_three_elements(tmp_path):
    write(tmp_path / "a.ply", scene(300, 2), {"recipe": "moe-gs"})
    elements = PlyData.read(tmp_path / "a.ply")
    assert [(e.name, e.count, len(e.properties)) for e in elements] == [("chunk", 2, 18), ("vertex", 300, 4), ("sh", 300, 24)]
    assert read_note(tmp_path / "a.ply") == {"recipe": "moe-gs"}


def test_equal_values_in_a_chunk(tmp_path):
    s = scene(5, 1)
    s = Splats(s.means[:1].expand(5, 3), s.log_scales[:1].expand(5, 3), s.quats, s.opacity_logit, s.sh[:1].expand(5, 4, 3))
    write(tmp_path / "a.ply", s, {})
    found = read(tmp_path / "a.ply")
    torch.testing.assert_close(found.means, s.means)
    torch.testing.assert_close(found.log_scales, s.log_scales)


def test_damaged_files(tmp_path):
    path = tmp_path / "a.ply"
    write(path, scene(300, 1), {})
    good = path.read_bytes()
    for data in (
        good[:-1],
        good[:300],
        good.replace(b"element vertex 300", b"element vertex 999"),
        good.replace(b"element vertex 300", b"element vertex -30"),
        good.replace(b"property uint packed_position", b"property float packed_position"),
        good.replace(b"property float min_x", b"property uint min_x"),
        good.replace(b"property uchar f_rest_0", b"property float f_rest_0"),
        good.replace(b"element chunk 2", b"element chunk 1"),
        good.replace(b"property float min_x", b"property float min_q"),
        good.replace(b"property uint packed_scale", b"property quad packed_scale"),
        good.replace(b"f_rest_8", b"f_rest_9"),
    ):
        path.write_bytes(data)
        with pytest.raises(InputError, match=naming(path)):
            read(path)


@pytest.mark.parametrize(("n", "degree"), [(1, 0), (256, 1), (600, 0), (600, 2), (300, 3)])
def test_files_of_supersplat_before_2(tmp_path, n, degree):
    """No ranges of colours: the bytes are the colours."""
    path, s = tmp_path / "old.compressed.ply", foreign.gaussians(n, degree)
    foreign.compressed_ply_before_2(path, s)
    found = read(path)
    assert recognise(path)[0] == "compressed-ply" and found.degree == degree
    assert np.abs(found.means.numpy() - s["means"]).max() < 0.005  # 1/1023 of 8 units, and half of it
    assert np.abs(found.log_scales.numpy() - s["log_scales"]).max() < 0.0025
    assert np.abs(found.opacity_logit.double().sigmoid().numpy() - 1 / (1 + np.exp(-s["logits"]))).max() < 0.51 / 255
    assert np.abs(found.sh[:, 0].numpy() - s["sh"][:, 0]).max() < 0.51 / 255 / foreign.C0 + 1e-6
    assert np.abs(found.sh[:, 1:].numpy() - s["sh"][:, 1:]).max(initial=0) < 0.51 * 8 / 256
    assert np.abs(np.abs((found.quats.numpy() * s["quats"]).sum(1)) - 1).max() < 1e-5


def test_other_spellings_of_the_header(tmp_path):
    path, s = tmp_path / "a.ply", foreign.gaussians(300, 1)
    foreign.compressed_ply_before_2(path, s)
    good, wanted = path.read_bytes(), read(path)
    head, body = good.split(b"end_header\n", 1)
    for old, new in (
        (b"property float ", b"property float32 "),
        (b"property uint ", b"property uint32 "),
        (b"property uchar ", b"property uint8 "),
    ):
        head = head.replace(old, new)
    path.write_bytes(head + b"end_header\n" + body)
    assert torch.equal(read(path).means, wanted.means)
    path.write_bytes(head.replace(b"\n", b"\r\n") + b"end_header\r\n" + body)
    assert torch.equal(read(path).sh, wanted.sh)


def test_only_a_file_that_was_cut_is_to_be_copied_again(tmp_path):
    path = tmp_path / "a.ply"
    write(path, scene(300, 1), {})
    good = path.read_bytes()
    for data, copied in ((good[:-1], True), (good.replace(b"property float min_x", b"property float min_q"), False)):
        path.write_bytes(data)
        with pytest.raises(InputError, match=naming(path)) as error:
            read(path)
        assert ("copy it" in str(error.value)) is copied
