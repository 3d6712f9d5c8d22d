"""The lists of formats and families: formats are recognised by content, and new ones come from outside in one call."""

import struct
import subprocess
import sys
from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from scene_experts.cli import main
from scene_experts.core.errors import InputError
from scene_experts.files import registry
from scene_experts.files.formats.splats import Splats
from scene_experts.files.registry import GAUSSIANS, about, exported_files, format_named, format_names, formats_of, read, recognise
from scene_experts.training.run_folder import open_run
from support.messages import naming
from support.splats import splats
from support.synthetic import make_capture

NOTE = {"recipe": "moe-gs", "psnr": 21.88}
STANDARD = sorted(formats_of(GAUSSIANS))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("n", [0, 1, 700])
def test_ply_is_exact(tmp_path, degree, n):
    s = splats(n, degree)
    format_named("ply").write(tmp_path / "a.ply", s, NOTE)
    found = read(tmp_path / "a.ply")
    assert all(torch.equal(getattr(found, name), getattr(s, name)) for name in ("means", "log_scales", "quats", "opacity_logit", "sh"))


@pytest.mark.parametrize("format", STANDARD)
def test_every_format_is_recognised_by_its_content(tmp_path, format):
    format_named(format).write(tmp_path / "whatever.bin", splats(300), NOTE)
    assert recognise(tmp_path / "whatever.bin") == (format, format_named(format))
    assert len(read(tmp_path / "whatever.bin")) == 300


def test_formats_state_what_they_are():
    assert set(format_names()) >= {"anchors", "compact", *STANDARD}
    assert set(formats_of("anchors")) == {"anchors", "compact", "html", "streamed-html"}
    suffixes = [format_named(name).suffix for name in format_names() if name not in ("baked-html", "streamed-html")]  # in place of html
    assert len(set(suffixes)) == len(suffixes) and all(about(name) for name in format_names())
    assert [name for name in format_names() if format_named(name).is_folder] == ["anchors"]
    assert format_named("splat").sh_degree == 0 and format_named("spz").sh_degree == 3


def test_a_name_is_imported_only_when_it_is_asked_for():
    code = "import sys, scene_experts.files.registry as r; r.format_named('ply'); print([m for m in sys.modules if '.formats.' in m])"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert "ply" in out and not any(name in out for name in ("sog", "html", "glb", "compact"))


def test_what_is_refused(tmp_path):
    with pytest.raises(InputError, match=naming("plx", "ply")):
        format_named("plx")
    with pytest.raises(InputError, match=naming(tmp_path / "a")):
        read(tmp_path / "a")
    (tmp_path / "a").write_bytes(b"plain words")
    with pytest.raises(InputError, match=naming(tmp_path / "a")):
        read(tmp_path / "a")
    assert registry.family_named("unheard") is None


def test_exported_files_are_those_with_the_names_that_export_chooses(tmp_path):
    ours = {"scene.compact", "scene.ply", "scene.ply.json", "scene_level1.compressed.ply", "scene_level12.spz.json", "scene.html"}
    others = {"scene.json", "scene.blend", "scenery.ply", "scene_levels.ply", "scene.ply.txt", "my_scene.ply", "scene_level.ply"}
    for name in ours | others:
        (tmp_path / name).touch()
    (tmp_path / "scene.spz").mkdir()
    assert {path.name for path in exported_files(tmp_path)} == ours


PAGE = Path(__file__).parents[3] / "docs" / "adding-a-format.md"
OUTSIDE = PAGE.read_text().partition("```python\n")[2].partition("```")[0]


def test_a_format_from_outside_is_one_file_and_one_call(tmp_path, monkeypatch, capsys):
    """The module of docs/adding-a-format.md: export, import, the help, recognition and clean-up know it."""
    monkeypatch.setattr(registry, "FORMATS", dict(registry.FORMATS))
    (tmp_path / "npz_gaussians.py").write_text(OUTSIDE)
    monkeypatch.syspath_prepend(str(tmp_path))
    registry.register("npz", "npz_gaussians")
    folder = make_capture(tmp_path / "capture", views=9, size=(24, 16), points=60).folder
    run = tmp_path / "run"
    train = ["train", "scaffold-gs", "--data", str(folder), "--out", str(run), "--iterations", "300", "--stop-at", "3", "--device", "cpu"]
    assert main(train) == 0
    capsys.readouterr()
    assert main(["export", str(run), "--format", "npz", "--refine", "0"]) == 0
    printed = capsys.readouterr().out
    assert str(run / "scene.npz") in printed and "PSNR" in printed and "degree 3" in printed
    assert recognise(run / "scene.npz")[0] == "npz" and run / "scene.npz" in exported_files(run)
    assert main(["import", str(run / "scene.npz"), "--data", str(folder), "--out", str(tmp_path / "again")]) == 0
    assert len(open_run(tmp_path / "again").scene.positions) == len(read(run / "scene.npz"))
    assert main(["export", str(run), "--format", "nzp"]) == 2 and "npz" in capsys.readouterr().err
    assert main(["export", "--help"]) == 0 and "NumPy arrays" in capsys.readouterr().out
    assert main([*train, "--overwrite"]) == 0 and not (run / "scene.npz").exists()


def test_a_format_of_an_installed_package_is_found(monkeypatch):
    point = EntryPoint("far", "scene_experts.files.formats.ply", registry.ENTRY_POINTS)
    monkeypatch.setattr("importlib.metadata.entry_points", lambda group: [point] if group == registry.ENTRY_POINTS else [])
    registry._installed.cache_clear()
    assert "far" in format_names() and format_named("far") is format_named("ply")
    monkeypatch.undo()
    registry._installed.cache_clear()


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    out = {}
    for format in STANDARD:
        path = tmp_path_factory.mktemp("good") / "a"
        format_named(format).write(path, splats(40, 1), NOTE)
        out[format] = path.read_bytes()
    return out


@given(st.sampled_from(STANDARD), st.integers(0, 2**32), st.integers(1, 4), st.sampled_from(["flip", "cut", "zero", "repeat"]))
@settings(max_examples=120, deadline=None)
def test_damage_of_any_kind_is_a_sentence_or_a_scene(good, tmp_path_factory, format, seed, times, kind):
    """Bytes changed anywhere: an InputError, or Gaussians of sound shapes; no other error, no endless work."""
    data = bytearray(good[format])
    end = data.find(b'id="code"') if format == "baked-html" else len(data)  # its renderer is no part of the scene
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
        found = read(path)
    except InputError as error:
        assert str(error) and "\n" not in str(error)
    else:
        assert isinstance(found, Splats)
