"""SPZ: every attribute within the format's quantum, in every version, and damaged files in one sentence."""

import gzip
import struct

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.files.formats import spz
from scene_experts.files.formats.pack import flip, turn
from scene_experts.files.formats.splats import NAMES, Splats
from support.messages import naming
from support.splat_quanta import check, scene


@given(st.integers(0, 300), st.integers(0, 3), st.integers(0, 99), st.sampled_from([1e-3, 1.0, 50.0, 1e5]))
@settings(max_examples=25, deadline=None)
def test_round_trip_within_the_quantum(tmp_path_factory, n, degree, seed, size):
    path = tmp_path_factory.mktemp("spz") / "a.spz"
    s = scene(n, degree, seed, size)
    spz.write(path, s, {})
    check("spz", spz.read(path), s)


def test_the_layout_byte_by_byte(tmp_path):
    """One Gaussian, from the format's description: 24-bit positions, bytes, the frame half turned about x."""
    sh = torch.zeros(1, 4, 3)
    sh[0, 0] = torch.tensor([1.0, 0.0, -1.0])
    sh[0, 1:, 0] = torch.tensor([0.5, 0.25, -0.5])
    s = Splats(torch.tensor([[1.0, -2.0, 3.0]]), torch.tensor([[-4.0, 0.0, 2.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.zeros(1), sh)
    head, body = spz.HEADER.unpack(gzip.decompress(spz.spz_bytes(s))[:16]), gzip.decompress(spz.spz_bytes(s))[16:]
    assert head == (0x5053474E, 3, 1, 1, 20, 0, 0)
    fixed = [int.from_bytes(body[3 * i : 3 * i + 3], "little", signed=True) for i in range(3)]
    assert fixed == [1 << 20, 2 << 20, -3 << 20]  # y and z flip
    assert list(body[9:13]) == [128, round((0.15 + 0.5) * 255), 128, round((-0.15 + 0.5) * 255)]
    assert list(body[13:16]) == [96, 160, 192]
    assert struct.unpack("<I", body[16:20])[0] == 3 << 30  # w is the largest, the others 0
    assert [body[20 + 3 * i] for i in range(3)] == [128 - 64, 128 - 32, 128 - 64]  # y, z flip, x does not


def read(folder, data):
    (folder / "a.spz").write_bytes(data)
    return spz.read(folder / "a.spz")


@pytest.mark.parametrize("version", [1, 2])
def test_old_versions(tmp_path, version):
    s = scene(40, 1)
    raw = gzip.decompress(spz.spz_bytes(s))
    now = read(tmp_path, spz.spz_bytes(s))
    flipped = spz.turn(now, "x")
    places = flipped.means.numpy().astype("<f2").tobytes() if version == 1 else raw[16 : 16 + 9 * 40]
    q = torch.nn.functional.normalize(flipped.quats, dim=1)
    q = q * torch.where(q[:, :1] < 0, -1.0, 1.0)
    turns = np.clip(np.rint((q[:, 1:].numpy() + 1) * 127.5), 0, 255).astype(np.uint8).tobytes()
    rest = raw[16 + 9 * 40 :]
    data = spz.HEADER.pack(spz.MAGIC, version, 40, 1, raw[13], 0, 0) + places + rest[: 7 * 40] + turns + rest[11 * 40 :]
    found = read(tmp_path, gzip.compress(data))
    torch.testing.assert_close(found.means, now.means, rtol=1e-3, atol=1e-4)
    assert torch.equal(found.sh, now.sh) and torch.equal(found.log_scales, now.log_scales)
    dots = (torch.nn.functional.normalize(found.quats, dim=1) * torch.nn.functional.normalize(now.quats, dim=1)).sum(1).abs()
    assert dots.min() > 0.995


def version_4(s, degree=None):
    zstandard = pytest.importorskip("zstandard")
    raw = gzip.decompress(spz.spz_bytes(s))
    n, found, bits = len(s), raw[12], raw[13]
    parts, at = [], 16
    for width in (9, 1, 3, 3, 4, 3 * ((found + 1) ** 2 - 1)):
        parts.append(raw[at : at + n * width])
        at += n * width
    parts = [p for p in parts if p]
    packed = [zstandard.ZstdCompressor().compress(p) for p in parts]
    table = b"".join(struct.pack("<QQ", len(p), len(r)) for p, r in zip(packed, parts))
    return spz.V4_HEADER.pack(spz.MAGIC, 4, n, found if degree is None else degree, bits, 0, len(parts), 32) + table + b"".join(packed)


@pytest.mark.parametrize("degree", [0, 3])
def test_version_4(tmp_path, degree):
    s = scene(50, degree)
    found, wanted = read(tmp_path, version_4(s)), read(tmp_path, spz.spz_bytes(s))
    for name in ("means", "log_scales", "quats", "opacity_logit", "sh"):
        assert torch.equal(getattr(found, name), getattr(wanted, name))


@pytest.mark.parametrize("asked", [False, True])
def test_the_flag_of_antialiasing(tmp_path, asked):
    s = scene(50, 1)
    spz.write(tmp_path / "a.spz", s, {"antialias": asked})
    assert gzip.decompress((tmp_path / "a.spz").read_bytes())[14] == int(asked) and spz.is_antialiased(tmp_path / "a.spz") is asked
    data = bytearray(version_4(s))
    data[14] = int(asked)
    (tmp_path / "b.spz").write_bytes(data)
    assert spz.is_antialiased(tmp_path / "b.spz") is asked
    for broken in (b"", b"NGSP", b"\x1f\x8b rubbish"):
        (tmp_path / "c.spz").write_bytes(broken)
        assert spz.is_antialiased(tmp_path / "c.spz") is False


FRAMES = {0: (1, -1, -1), 1: (-1, 1, -1), 2: (1, 1, -1), 3: (-1, -1, -1), 4: (1, -1, -1), 5: (-1, 1, 1), 6: (1, 1, 1), 8: (1, -1, 1)}
"""Frame in a file (LDB is 1, RDB 2, LUB 3, RUB 4, LDF 5, RDF 6, RUF 8; 0 is unknown) -> its axes in ours, which is RDF."""


def with_records(s, kind, records):
    """A file with records: at the end of the gzip stream, or in version 4 between the header and the table."""
    data = bytearray(version_4(s) if kind == 4 else gzip.decompress(spz.spz_bytes(s)))
    data[14] |= spz.EXTENDED
    if kind != 4:
        return gzip.compress(bytes(data) + records)
    data[16:20] = struct.pack("<I", 32 + len(records))
    return bytes(data[:32]) + records + bytes(data[32:])


@pytest.mark.parametrize("kind", [3, 4])
@pytest.mark.parametrize("frame", list(FRAMES))
def test_records_of_other_programs_are_passed_over_and_their_frame_is_followed(tmp_path, kind, frame):
    s = scene(50, 2)
    own = read(tmp_path, spz.spz_bytes(s))
    orbit = struct.pack("<IIfff", 0xADBE0002, 12, -0.5, 0.5, 1.0)
    found = read(tmp_path, with_records(s, kind, orbit))
    named = read(tmp_path, with_records(s, kind, orbit + struct.pack("<III", spz.FRAME, 4, frame)))
    wanted = flip(turn(own, "x"), FRAMES[frame])
    for name in NAMES:
        assert torch.equal(getattr(found, name), getattr(own, name))
        assert torch.equal(getattr(named, name), getattr(wanted, name))


@pytest.mark.parametrize("kind", [3, 4])
def test_records_that_do_not_fit(tmp_path, kind):
    s = scene(50, 2)
    for odd in (b"", b"\0" * 5, struct.pack("<If", 0xADBE0002, -0.5), struct.pack("<II", spz.FRAME, 4)):  # older files have no lengths
        assert len(read(tmp_path, with_records(s, kind, odd))) == 50
    with pytest.raises(InputError, match=naming("a.spz", 16)):
        read(tmp_path, with_records(s, kind, struct.pack("<III", spz.FRAME, 4, 16)))


def test_sizes_that_the_format_cannot_hold_are_counted(tmp_path):
    s = scene(100)
    s.log_scales[:] = s.log_scales.clamp(-9, 5)
    s.log_scales[:40, 0] = -20.0  # flat: harmless
    assert spz.write(tmp_path / "a.spz", s, {}) is None
    s.log_scales[10], s.log_scales[20, 1] = -11.0, 7.0
    told = spz.write(tmp_path / "a.spz", s, {})
    assert told is not None and told.startswith("warning: 2 of 100 ") and "4.5e-05 to 380 units" in told and "ply" in told


def test_damaged_files(tmp_path):
    good = spz.spz_bytes(scene(30, 2))
    raw = gzip.decompress(good)
    bomb = gzip.compress(spz.HEADER.pack(spz.MAGIC, 3, 40_000_000, 3, 12, 0, 0) + bytes(10_000_000))
    cases = {
        good[:-20]: "",
        good[:8]: "",
        b"\x1f\x8b rubbish": "",
        gzip.compress(raw[:-5]): "1,320",
        gzip.compress(raw + b"x"): "1,320",
        gzip.compress(b"XXXX" + raw[4:]): "",
        gzip.compress(raw[:4] + struct.pack("<I", 9) + raw[8:]): "9",
        gzip.compress(raw[:12] + b"\x09" + raw[13:]): "9",
        gzip.compress(raw[:8] + struct.pack("<I", 1 << 31) + raw[12:]): "2,147,483,648",
        bomb: "40,000,000",
        version_4(scene(30))[:-9]: "",
        version_4(scene(30))[:40]: "6",
        version_4(scene(30), degree=1): "",
        version_4(scene(30))[:20]: "",
    }
    for i, (data, fact) in enumerate(cases.items()):
        path = tmp_path / f"{i}.spz"
        path.write_bytes(data)
        with pytest.raises(InputError, match=naming(path, fact)):
            spz.read(path)
    with pytest.raises(InputError, match="SPZ"):
        spz.spz_bytes(scene(3, 0, 0, 1e8))
