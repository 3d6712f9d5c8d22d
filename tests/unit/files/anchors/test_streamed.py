"""The streamed page: its files, its settings, and what `read` says about parts that are missing, damaged or somebody else's."""

import gzip
import hashlib
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files import registry
from scene_experts.files.anchors import compact, layers, streamed
from scene_experts.files.anchors.coarse import Layered
from scene_experts.files.anchors.precision import from_spread
from scene_experts.files.formats import html
from support.layers import make_coarse
from support.live_scenes import contents_of, make_run
from support.places import ROOT


@pytest.fixture
def page(tmp_path, monkeypatch):
    monkeypatch.setattr(layers, "ANCHORS", 40)
    write(tmp_path / "a.html")
    return tmp_path / "a.html"


def write(path: Path, seed: int = 0) -> str:
    data = contents_of(make_run("octree-gs"))
    data = replace(data, precision=from_spread(data.columns, data.networks))
    rows, coarse = make_coarse(data, seed=seed)
    return streamed.write(path, Layered(data, rows, coarse, torch.ones(len(data.columns["xyz"]))), {"title": "a scene"})


def settings_of(path):
    return html.settings_in(path.read_bytes())


def test_the_page_lists_its_parts_and_reads_back(page, tmp_path):
    settings = settings_of(page)
    names = [name for name, *_ in settings["parts"]]
    assert settings["folder"] == "a.parts" and [name.split("-")[0] for name in names[:3]] == ["coarse", "plan", "00"] and len(names) > 3
    assert sorted(names) == sorted(p.name for p in (tmp_path / "a.parts").iterdir())
    assert all((tmp_path / "a.parts" / name).stat().st_size == size for name, size, _ in settings["parts"])
    assert b'id="scene"></script>' in page.read_bytes() and registry.recognise(page)[0] == "streamed-html"
    data = contents_of(make_run("octree-gs"))
    compact.write(tmp_path / "a.compact", replace(data, precision=from_spread(data.columns, data.networks)), {})
    found, wanted = streamed.read(page), compact.read(tmp_path / "a.compact")
    rows = lambda scene: sorted(map(tuple, scene.columns["feature"].tolist()))  # noqa: E731
    assert rows(found) == rows(wanted) and found.columns.keys() == wanted.columns.keys()


def test_parts_of_an_older_page_go_and_other_files_stay(page, tmp_path):
    before = {p.name for p in (tmp_path / "a.parts").iterdir()}
    (tmp_path / "a.parts" / "notes.txt").write_text("mine")
    assert "in a.parts, shown after" in write(page, seed=1)
    after = {p.name for p in (tmp_path / "a.parts").iterdir()}
    assert after == {name for name, *_ in settings_of(page)["parts"]} | {"notes.txt"} and before != after
    streamed.read(page)


def test_missing_damaged_and_foreign_parts_are_one_sentence(page, tmp_path):
    for name, *_ in settings_of(page)["parts"]:
        part = tmp_path / "a.parts" / name
        content = part.read_bytes()
        for broken in (None, b"", content[:-3], content[:20] + b"?" + content[21:]):
            part.unlink() if broken is None else part.write_bytes(broken)
            with pytest.raises(InputError, match=re.escape(name)):
                streamed.read(page)
            part.write_bytes(content)
    text = page.read_bytes()
    for old, new in (
        (b'"folder": "a.parts"', b'"folder": "../a.parts"'),
        (b'"folder": "a.parts"', b'"folder": ".."'),
        (b'"coarse-', b'"/etc/coarse-'),
        (b'"parts": [', b'"parts": [1, '),
    ):
        assert old in text
        page.write_bytes(text.replace(old, new))
        with pytest.raises(InputError, match="html page"):
            streamed.read(page)


def test_the_script_is_made_of_its_sources_and_asks_for_its_parts_alone():
    """`node build_live.js` in tools/viewer makes it."""
    packed = (html.ASSETS / streamed.CODE).read_bytes()
    head, _, code = gzip.decompress(packed).decode().partition("\n")
    found = hashlib.sha256()
    reader = ROOT / "integrations" / "javascript"
    for path in (*sorted((ROOT / "tools" / "viewer" / "live").iterdir()), reader / "compact.mjs", reader / "layers.mjs"):
        found.update(path.read_bytes())
    assert head == f"// {found.hexdigest()}", "build it: node build_live.js in tools/viewer"
    assert len(packed) < 80_000 and len(re.findall(r"\bfetch\(", code)) == 1
    assert not re.search(r"XMLHttpRequest|\bimport\(|importScripts|https?://|WebSocket|sendBeacon", code)
