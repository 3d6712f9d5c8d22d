"""SOG: every attribute within its quantum, the palette close to what it stands for, damaged archives in one sentence."""

import io
import json
import time
import zipfile

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.files.formats import sog
from scene_experts.files.formats.splats import Splats
from support.messages import naming
from support.splat_quanta import check, differences, in_file_order, scene


@given(st.integers(1, 300), st.integers(0, 3), st.integers(0, 99), st.sampled_from([1e-3, 1.0, 1e4]))
@settings(max_examples=20, deadline=None)
def test_round_trip_within_the_quantum(tmp_path_factory, n, degree, seed, size):
    path = tmp_path_factory.mktemp("sog") / "a.sog"
    s = scene(n, degree, seed, size)
    sog.write(path, s, {})
    check("sog", sog.read(path), s)


def test_the_palette_is_near_and_the_bytes_are_the_same_twice(tmp_path):
    g = torch.Generator().manual_seed(1)
    s = scene(5000, 3)
    kinds = 0.3 * torch.randn(40, 15, 3, generator=g)
    sh = torch.cat([s.sh[:, :1], kinds[torch.randint(40, (5000,), generator=g)] + 0.01 * torch.randn(5000, 15, 3, generator=g)], 1)
    s = Splats(s.means, s.log_scales, s.quats, s.opacity_logit, sh)
    first = sog.sog_bytes(s, {"a": 1})
    assert first == sog.sog_bytes(s, {"a": 1})
    (tmp_path / "a.sog").write_bytes(first)
    wrong = differences(sog.read(tmp_path / "a.sog"), in_file_order("sog", s))["sh"]
    assert wrong[:, 1:].square().mean().sqrt() < 0.012  # the noise alone has 0.01
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        meta = json.loads(archive.read("meta.json"))
    assert meta["version"] == 2 and meta["count"] == 5000 and meta["asset"]["scene-experts"] == {"a": 1} and meta["shN"]["count"] <= 4096


@pytest.mark.parametrize("asked", [False, True])
def test_the_entry_of_antialiasing(tmp_path, asked):
    """The format's description requires it; viewers draw the file by it."""
    sog.write(tmp_path / "a.sog", scene(50, 1), {"antialias": asked})
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert json.loads(archive.read("meta.json"))["antialias"] is asked
    assert sog.FORMAT.antialias and sog.FORMAT.is_antialiased is sog.is_antialiased and sog.is_antialiased(tmp_path / "a.sog") is asked
    for content in ({"version": 2}, {"antialias": 1}):
        (tmp_path / "b.sog").write_bytes(sog._zip({"meta.json": json.dumps(content).encode()}))
        assert sog.is_antialiased(tmp_path / "b.sog") is False
    (tmp_path / "b.sog").write_bytes(sog._zip({"meta.json": b"[1]"}))
    with pytest.raises(InputError, match=naming("b.sog")):
        sog.is_antialiased(tmp_path / "b.sog")


@pytest.mark.slow
def test_a_scene_of_usual_size_takes_seconds():
    began = time.process_time()
    assert len(sog.sog_bytes(scene(60_000, 3), {})) < 60_000 * 42
    assert time.process_time() - began < 20


def test_damaged_files(tmp_path):
    data = sog.sog_bytes(scene(100, 1), {})
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])

    def refused(changed, fact="", raw=None):
        (tmp_path / "a.sog").write_bytes(raw if raw is not None else sog._zip(files | changed))
        with pytest.raises(InputError, match=naming("a.sog", fact)):
            sog.read(tmp_path / "a.sog")

    def described(**parts):
        return {"meta.json": json.dumps(meta | parts).encode()}

    refused({}, raw=data[:-30])
    refused({}, raw=data[: len(data) // 2])
    refused({"meta.json": b"{"})
    refused({"meta.json": b"[1]"})
    refused(described(version=1), "version 1")
    refused(described(count=10**9), 10**9)
    refused(described(count=-1), -1)
    refused(described(count=5000), "means")
    refused(described(scales=meta["scales"] | {"codebook": [0.0]}))
    refused(described(means=meta["means"] | {"files": ["../x", "y"]}))
    refused(described(shN=meta["shN"] | {"count": 1}))
    refused(described(shN=meta["shN"] | {"bands": 3}))
    refused(described(sh0=meta["sh0"] | {"codebook": [float("nan")] * 256}))
    refused({"quats.webp": b"RIFF"})
    refused({"quats.webp": sog._webp(torch.zeros(4, 4).numpy(), 3000, 3000)}, 3000)
    with pytest.raises(InputError, match="SOG"):
        sog.sog_bytes(scene(0), {})
