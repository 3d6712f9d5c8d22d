"""The streamed page: its files, its settings, and what `read` says about parts that are missing, damaged or somebody else's."""

import gzip
import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path
from typing import Any

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


def write(path: Path, seed: int = 0, coarser: float = 1.0) -> str:
    data = contents_of(make_run("octree-gs"))
    precision = from_spread(data.columns, data.networks)
    data = replace(data, precision=replace(precision, steps={name: coarser * value for name, value in precision.steps.items()}))
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
    said, own = write(page, seed=1), page.stat().st_size
    sizes = [size for _, size, _ in settings_of(page)["parts"]]
    assert said.startswith(f"page {own / 1e6:.2f}, {len(sizes)} parts {sum(sizes) / 1e6:.2f} in a.parts, shown after")
    assert streamed.size(page) == own + sum(sizes)
    after = {p.name for p in (tmp_path / "a.parts").iterdir()}
    assert after == {name for name, *_ in settings_of(page)["parts"]} | {"notes.txt"} and before != after
    streamed.read(page)


def test_parts_of_other_content_have_other_names(tmp_path, monkeypatch):
    monkeypatch.setattr(layers, "ANCHORS", 40)
    for name, coarser in (("a", 1), ("b", 2), ("c", 1)):
        write(tmp_path / f"{name}.html", coarser=coarser)
    a, b, c = (settings_of(tmp_path / f"{name}.html")["parts"] for name in "abc")
    assert len({checksum for _, _, checksum in (*a, *b)}) == len(a) + len(b) and a == c
    assert all(name.endswith(f"-{checksum:08x}.bin") for name, _, checksum in a)


def mix(folder: Path) -> list[tuple[list[Any], bytes]]:
    """A second export, coarser, and for each part of the first one its entry and wrong bytes: those of that part of the second, and bytes
    of the right length and with the right end."""
    write(folder / "b.html", coarser=2)
    own, other = settings_of(folder / "a.html")["parts"], settings_of(folder / "b.html")["parts"]
    out = []
    for entry, (foreign, *_) in zip(own, other):
        name, size, checksum = entry
        content = (folder / "b.parts" / foreign).read_bytes()
        same = ((folder / "a.parts" / name).read_bytes() + content)[-size:]
        out += [(entry, content), (entry, same[:-4] + checksum.to_bytes(4, "little"))]
    return out


SENTENCE = r"expected the part .*found .*belongs to another export or is damaged; copy the page and its folder of parts again, or export"


def test_parts_of_another_export_are_refused(page, tmp_path):
    for (name, *_), foreign in mix(tmp_path):
        part = tmp_path / "a.parts" / name
        content = part.read_bytes()
        part.write_bytes(foreign)
        with pytest.raises(InputError, match=SENTENCE) as caught:
            streamed.read(page)
        assert str(part) in str(caught.value) and str(page) in str(caught.value)
        part.write_bytes(content)
    streamed.read(page)


PROGRAM = f"""
import {{ readFileSync }} from "node:fs";
import {{ expectPart }} from {json.dumps((ROOT / "integrations/javascript/layers.mjs").as_uri())};
console.log(JSON.stringify(JSON.parse(readFileSync(0)).map(([path, part]) => {{
  try {{ expectPart(new Uint8Array(readFileSync(path)), part); return ""; }} catch (error) {{ return error.message; }}
}})));
"""


@pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed")
def test_the_reader_in_javascript_refuses_parts_of_another_export(page, tmp_path):
    listed = settings_of(page)["parts"]
    good, bad = [[str(tmp_path / "a.parts" / part[0]), part] for part in listed], []
    for i, (entry, foreign) in enumerate(mix(tmp_path)):
        (tmp_path / str(i)).write_bytes(foreign)
        bad.append([str(tmp_path / str(i)), entry])
    for i, short in enumerate((b"", b"abc")):
        (tmp_path / f"short{i}").write_bytes(short)
        bad += [[str(tmp_path / f"short{i}"), [name, size, 0]] for name, size in (("00-00000000.bin", len(short)), ("00-00000000.bin", 9))]
    (tmp_path / "read.mjs").write_text(PROGRAM)
    done = subprocess.run(["node", str(tmp_path / "read.mjs")], input=json.dumps(good + bad), capture_output=True, text=True, check=True)
    found = json.loads(done.stdout)
    assert found[: len(good)] == [""] * len(good) and all(re.match(SENTENCE, said) for said in found[len(good) :])
    assert all(part[0] in said for said, (_, part) in zip(found[len(good) :], bad))


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
        (b'"parts": [[', b'"parts": [["00-00000000.bin", 9, -1], ['),
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
    for path in (*sorted((ROOT / "tools" / "viewer" / "live").iterdir()), *sorted((ROOT / "integrations" / "javascript").iterdir())):
        found.update(path.read_bytes())
    assert head == f"// {found.hexdigest()}", "build it: node build_live.js in tools/viewer"
    assert len(packed) < 80_000 and len(re.findall(r"\bfetch\(", code)) == 1
    assert not re.search(r"XMLHttpRequest|\bimport\(|importScripts|https?://|WebSocket|sendBeacon", code)
