"""The table of formats: what is written comes back by content, and what is none of them is refused in one sentence."""

import struct

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.files.formats.comments import read_note
from scene_experts.files.formats.splats import Splats
from scene_experts.files.formats.standard import FORMATS, format_of, read_standard, write_standard
from support.messages import naming
from support.splats import splats

NOTE = {"recipe": "moe-gs", "psnr": 21.88}


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 700])
def test_ply_is_exact(tmp_path, degree, n):
    s = splats(n, degree)
    write_standard(tmp_path / "a.ply", s, "ply", NOTE)
    found = read_standard(tmp_path / "a.ply")
    assert all(torch.equal(getattr(found, name), getattr(s, name)) for name in ("means", "log_scales", "quats", "opacity_logit", "sh"))


@pytest.mark.parametrize("format", FORMATS)
def test_every_format_is_known_by_its_content(tmp_path, format):
    write_standard(tmp_path / "whatever.bin", splats(300), format, NOTE)
    assert format_of(tmp_path / "whatever.bin") == format
    assert len(read_standard(tmp_path / "whatever.bin")) == 300


def test_what_is_refused(tmp_path):
    with pytest.raises(InputError, match=naming("plx", "ply")):
        write_standard(tmp_path / "a", splats(), "plx", {})
    s = splats()
    s.sh[2, 1, 0] = float("nan")
    with pytest.raises(InputError, match=naming("sh", 1)):
        write_standard(tmp_path / "a", s, "ply", {})
    with pytest.raises(InputError, match=naming(tmp_path / "a")):
        read_standard(tmp_path / "a")
    (tmp_path / "a").write_bytes(b"plain words")
    with pytest.raises(InputError, match=naming(tmp_path / "a")):
        read_standard(tmp_path / "a")


def test_what_only_a_page_shows_is_not_in_other_files(tmp_path):
    write_standard(tmp_path / "a.ply", splats(), "ply", NOTE | {"cameras": [1, 2], "background": [0, 0, 0]})
    assert read_note(tmp_path / "a.ply") == NOTE


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    out = {}
    for format in FORMATS:
        path = tmp_path_factory.mktemp("good") / "a"
        write_standard(path, splats(40, 1), format, NOTE)
        out[format] = path.read_bytes()
    return out


@given(st.sampled_from(sorted(FORMATS)), st.integers(0, 2**32), st.integers(1, 4), st.sampled_from(["flip", "cut", "zero", "repeat"]))
@settings(max_examples=120, deadline=None)
def test_damage_of_any_kind_is_a_sentence_or_a_scene(good, tmp_path_factory, format, seed, times, kind):
    """Bytes changed anywhere: an InputError, or Gaussians of sound shapes; no other error, no endless work."""
    data = bytearray(good[format])
    end = data.find(b'id="code"') if format == "html" else len(data)  # its renderer is no part of the scene
    for i in range(times):
        at = (seed >> i) * 2654435761 % min(end, len(data))
        if kind == "flip":
            data[at] ^= 1 << (seed + i) % 8
        elif kind == "cut":
            del data[max(at, 1) :]
            break
        elif kind == "zero":
            data[at : at + 4] = bytes(len(data[at : at + 4]))
        else:
            data[at:at] = struct.pack("<I", seed % 2**32)
    path = tmp_path_factory.mktemp("bad") / "a"
    path.write_bytes(bytes(data))
    try:
        found = read_standard(path)
    except InputError as error:
        assert str(error) and "\n" not in str(error)
    else:
        assert isinstance(found, Splats)
