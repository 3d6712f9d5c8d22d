"""SOG: every attribute within its quantum, the palette close to what it stands for, damaged archives in one sentence."""

import io
import json
import time
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.core.errors import InputError
from scene_experts.files import registry
from scene_experts.files.formats import sog
from scene_experts.files.formats.splats import Splats
from support import foreign
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


# --- folders and version 1 ----------------------------------------------------------------------------------------------------------------


def test_a_folder_is_read_as_the_zip_of_its_files(tmp_path):
    s = scene(200, 2)
    sog.write(tmp_path / "a.sog", s, {"antialias": True})
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        archive.extractall(tmp_path / "folder")
    wanted = sog.read(tmp_path / "a.sog")
    assert sog.is_antialiased(tmp_path / "folder" / "meta.json")
    for place in (tmp_path / "folder", tmp_path / "folder" / "meta.json"):
        assert all(torch.equal(a, b) for a, b in zip(vars(registry.read(place)).values(), vars(wanted).values()))
    (tmp_path / "folder" / "quats.webp").unlink()
    with pytest.raises(InputError, match=naming("quats.webp", "no such file")):
        registry.read(tmp_path / "folder")


def test_a_folder_leads_nowhere(tmp_path):
    files = foreign.sogs_1(foreign.gaussians(50))
    meta = json.loads(files["meta.json"])
    foreign.folder(tmp_path / "a", files)
    (tmp_path / "quats.webp").write_bytes(files["quats.webp"])
    for name in ("../quats.webp", str(tmp_path / "quats.webp")):
        meta["quats"]["files"] = [name]
        (tmp_path / "a" / "meta.json").write_text(json.dumps(meta))
        with pytest.raises(InputError, match=naming("meta.json", "leads out")):
            registry.read(tmp_path / "a")
    (tmp_path / "a" / "meta.json").write_text("{" + " " * (1 << 20) + "}")
    with pytest.raises(InputError, match=naming("meta.json", "1,048,578")):
        registry.read(tmp_path / "a")


@pytest.mark.parametrize(("degree", "kind", "bits"), [(0, "WEBP", 8), (1, "PNG", 8), (2, "WEBP", 6), (3, "WEBP", 8)])
@pytest.mark.parametrize("packed", [False, True])
def test_the_first_version(tmp_path, degree, kind, bits, packed):
    s, path = foreign.gaussians(300, degree), tmp_path / "v1"
    files = foreign.sogs_1(s, kind, bits)
    path.write_bytes(foreign.zipped(files)) if packed else foreign.folder(path, files)
    found = registry.read(path)
    assert len(found) == 300 and found.degree == degree
    place = np.log1p(np.abs(s["means"]))
    assert (np.abs(found.means.numpy() - s["means"]) / (1 + np.abs(s["means"]))).max() < 0.51 * 2 * place.max() / 65535 + 1e-6
    assert np.abs(found.log_scales.numpy() - s["log_scales"]).max() < 0.51 * 4 / 255
    assert np.abs(found.opacity_logit.numpy() - s["logits"]).max() < 0.51 * 8 / 255
    assert np.abs(found.sh[:, 0].numpy() - s["sh"][:, 0]).max() < 0.51 * 3 / 255
    assert np.abs(found.sh[:, 1:].numpy() - s["sh"][:, 1:]).max(initial=0) < 0.51 * 1.8 / ((1 << bits) - 1) + 1e-6
    assert np.abs(np.abs((found.quats.numpy() * s["quats"]).sum(1)) - 1).max() < 1e-3


def test_a_zip_of_the_folder_around_the_files(tmp_path):
    files = foreign.sogs_1(foreign.gaussians(60))
    around = {"__MACOSX/scene/meta.json": b"x"} | {f"scene/{name}": data for name, data in files.items()}
    (tmp_path / "a.zip").write_bytes(foreign.zipped(around))
    assert registry.recognise(tmp_path / "a.zip")[0] == "sog" and len(registry.read(tmp_path / "a.zip")) == 60


def test_damaged_first_versions(tmp_path):
    files = foreign.sogs_1(foreign.gaussians(100, 1))
    for part, entry, value, fact in (
        ("quats", "encoding", "other", "other"),
        ("means", "shape", [0, 3], "0"),
        ("means", "shape", [10**9, 3], "1000000000"),
        ("means", "shape", [500, 3], "means"),
        ("means", "maxs", [1e300, 1, 1], ""),
        ("scales", "mins", [0.0, 0.0], ""),
        ("scales", "maxs", [1e39, 1, 1], ""),
        ("sh0", "mins", None, ""),
        ("sh0", "files", [], ""),
        ("shN", "shape", [100, 6], "palette"),
        ("shN", "quantization", 9, "9"),
        ("shN", "mins", "low", ""),
    ):
        meta = json.loads(files["meta.json"])
        meta[part][entry] = value
        (tmp_path / "a.sog").write_bytes(foreign.zipped(files | {"meta.json": json.dumps(meta).encode()}))
        with pytest.raises(InputError, match=naming("a.sog", fact)) as error:
            sog.read(tmp_path / "a.sog")
        assert "copy it" not in str(error.value)
    meta = json.loads(files["meta.json"])
    del meta["scales"]
    (tmp_path / "a.sog").write_bytes(foreign.zipped(files | {"meta.json": json.dumps(meta).encode()}))
    with pytest.raises(InputError, match=naming("a.sog", "'scales'", "convert")):
        sog.read(tmp_path / "a.sog")


def test_streamed_scenes_are_refused_with_a_way_that_works(tmp_path):
    text = json.dumps({"version": 1, "lodLevels": 2, "filenames": ["0_0/meta.json"], "tree": {}}).encode()
    foreign.folder(tmp_path / "a", {"lod-meta.json": text})
    (tmp_path / "a.zip").write_bytes(foreign.zipped({"b/lod-meta.json": text, "b/0_0/meta.json": b"{}"}))
    (tmp_path / "renamed.json").write_bytes(text)
    for path in (tmp_path / "renamed.json", tmp_path / "a", tmp_path / "a" / "lod-meta.json", tmp_path / "a.zip"):
        with pytest.raises(InputError, match=naming("lod-meta.json", "0_*/meta.json")):
            registry.read(path)
