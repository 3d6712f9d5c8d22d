"""The live page: what it holds, what it refuses, and the decode of its script without a graphics device."""

import gzip
import hashlib
import json
import re
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.files.anchors import compact, live
from scene_experts.files.formats import html
from scene_experts.files.options import DEFAULT
from scene_experts.files.registry import recognise
from scene_experts.view.filled import First
from scene_experts.view.paint import PALETTE
from support.live_scenes import CASES, WORLD, compare, contents_of, decoded, look, make_run, scene_in_page
from support.messages import naming
from support.places import ROOT
from support.splats import splats

VIEWER = ROOT / "tools" / "viewer"
NODE = shutil.which("node")
SEEN = look((0.3, -0.4, -1.0))


def write(path, case, **note):
    run = make_run(case)
    live.write(path, contents_of(run), {"cameras": [SEEN.pose], "nearest": 0.004, **note})
    return run


def settings_of(path):
    return json.loads(re.search(rb'id="settings">(.*?)</script>', path.read_bytes(), re.DOTALL)[1])


@pytest.mark.parametrize("case", ["scene-experts", "octree-gs"])
def test_a_page_holds_the_compact_file_and_is_recognised(tmp_path, case):
    run = write(tmp_path / "a.html", case, title="<b>")
    compact.write(tmp_path / "a.compact", contents_of(run), {})
    found, wanted = live.read(tmp_path / "a.html"), compact.read(tmp_path / "a.compact")
    assert all(torch.equal(found.columns[name], value) for name, value in wanted.columns.items())
    assert all(torch.equal(found.networks[name], value) for name, value in wanted.networks.items())
    assert recognise(tmp_path / "a.html")[0] == "html" and b"<title>&lt;b&gt;</title>" in (tmp_path / "a.html").read_bytes()
    html.write(tmp_path / "b.html", splats(4), {})
    assert recognise(tmp_path / "b.html")[0] == "baked-html"


def test_settings_say_how_to_decode(tmp_path):
    heads = {}
    for case in ("scene-experts", "scaffold-gs", "moe-gs", "moe-gs-dist", "moe-gs-e3-dense", "moe-gs-posrouter", "margin"):
        write(tmp_path / "a.html", case, background=(0.1, 0.2, 0.3))
        found = settings_of(tmp_path / "a.html")
        heads[case] = [found["heads"]["cov"][name] for name in ("k", "alone", "weigh", "position", "distance")]
    assert heads == {
        "scene-experts": [1, None, "softmax", True, 1.0],
        "scaffold-gs": [1, 0, "softmax", False, 1.0],
        "moe-gs": [2, None, "softmax", False, 1.0],
        "moe-gs-dist": [2, None, "softmax", False, 2.0],
        "moe-gs-e3-dense": [3, None, "softmax", False, 1.0],
        "moe-gs-posrouter": [2, None, "softmax", True, 1.0],
        "margin": [2, None, "margin", False, 1.0],
    }
    assert found["background"] == [0.1, 0.2, 0.3] and found["nearest"] == 0.004
    assert found["exact"] is False and found["levels"] is None and len(found["poses"]) == 1


def test_settings_have_a_colour_for_each_of_several_experts(tmp_path):
    for case, count in (("scene-experts", 5), ("moe-gs-e3-dense", 3), ("scaffold-gs", None)):
        write(tmp_path / "a.html", case)
        found = settings_of(tmp_path / "a.html")["experts"]
        assert found is None if count is None else [tuple(color) for color in found] == list(PALETTE[:count])


def test_first_views_are_those_that_fill_screens(tmp_path, monkeypatch):
    """They are chosen by pictures of the scene, and are in the frame of the page."""
    run, asked = make_run("scaffold-gs"), []

    def find(capture, draw):
        picture = draw(SEEN.camera)
        asked.append((capture, picture.alpha.shape, float(picture.alpha.max())))
        return [First(SEEN.camera, 1.0)]

    monkeypatch.setattr(live, "find_first_views", find)
    note = live.look(run, "a capture", WORLD, DEFAULT, None)
    assert asked[0][:2] == ("a capture", (240, 320)) and asked[0][2] > 0.1
    live.write(tmp_path / "a.html", contents_of(run), {"cameras": [SEEN.pose], **note})
    found = settings_of(tmp_path / "a.html")
    place = np.array(found["first"][0]["position"]) + found["centre"]
    np.testing.assert_allclose(place, SEEN.pose["position"], atol=1e-5)
    assert found["first"][0]["fov"] == pytest.approx(50, abs=1e-3) and found["first"][0]["aspect"] == pytest.approx(4 / 3)


def test_photographs_are_in_the_poses_and_in_the_size(tmp_path):
    run = make_run("scaffold-gs")
    plain = live.write(tmp_path / "a.html", contents_of(run), {"cameras": [SEEN.pose, SEEN.pose]})
    told = live.write(tmp_path / "b.html", contents_of(run), {"cameras": [SEEN.pose, SEEN.pose], "pictures": [b"", b"RIFF...."]})
    assert [pose.get("picture") for pose in settings_of(tmp_path / "b.html")["poses"]] == [None, "data:image/webp;base64,UklGRi4uLi4="]
    assert "photographs" not in plain and ", 12 bytes of photographs, " in told


def test_values_that_no_half_holds_are_held_in_32_bits(tmp_path):
    data = contents_of(make_run("scaffold-gs"))
    data.columns["feature"][0, 0] = 1e6
    live.write(tmp_path / "a.html", data, {})
    assert settings_of(tmp_path / "a.html")["exact"] is True


def test_what_the_script_cannot_draw_is_refused(tmp_path):
    plain = contents_of(make_run("scaffold-gs"))
    scene = plain.about["train"]["scene"]
    moe = contents_of(make_run("moe-gs"))
    router = {**moe.about["train"]["scene"], "decoder": {"type": "Experts", "router": {"type": "Oracle"}}}
    cases = {
        "a feature bank": contents_of(make_run("scaffold-gs-bank")),
        "middle": contents_of(make_run("scaffold-gs-depth4")),
        "description": replace(plain, about=None),
        "Nearest selects": replace(plain, about={**plain.about, "train": {"scene": {**scene, "select": {"type": "Nearest"}}}}),
        "Oracle chooses": replace(moe, about={**moe.about, "train": {"scene": router}}),
    }
    for found, data in cases.items():
        with pytest.raises(InputError, match=naming("script", found, "--format baked-html")):
            live.write(tmp_path / "a.html", data, {})
    assert not (tmp_path / "a.html").exists()


def test_damaged_pages_are_refused(tmp_path):
    write(tmp_path / "a.html", "scaffold-gs")
    page = (tmp_path / "a.html").read_bytes()
    at = page.index(b'id="scene">') + 200
    for broken in (page[:at], page[:at] + b"?" + page[at + 1 :], page.replace(page[at : at + 40], b"A" * 40)):
        (tmp_path / "b.html").write_bytes(broken)
        with pytest.raises(InputError, match="html page"):
            live.read(tmp_path / "b.html")


def test_the_script_is_made_of_its_sources_is_small_and_asks_for_nothing():
    """`node build_live.js` in tools/viewer makes it."""
    packed = (html.ASSETS / live.CODE).read_bytes()
    head, _, code = gzip.decompress(packed).decode().partition("\n")
    found = hashlib.sha256()
    for path in (*sorted((VIEWER / "live").iterdir()), *sorted((ROOT / "integrations" / "javascript").iterdir())):
        found.update(path.read_bytes())
    assert head == f"// {found.hexdigest()}", "build it: node build_live.js in tools/viewer"
    assert len(packed) < 80_000
    assert not re.search(r"\bfetch\(|XMLHttpRequest|\bimport\(|importScripts|https?://|WebSocket|sendBeacon", code)


PROGRAM = """
import { readFileSync, writeFileSync } from "node:fs";
import { CpuDecoder } from "VIEWER/decode.js";
import { makeGroups } from "VIEWER/scene.js";
import { openScene } from "VIEWER/worker.js";
for (const job of JSON.parse(readFileSync(process.argv[2]))) {
  const page = readFileSync(job.page, "utf8"), part = (id) => page.split(`id="${id}">`)[1].split("<")[0];
  const scene = await openScene(part("scene"), JSON.parse(part("settings"))), decoder = new CpuDecoder(scene), { K } = scene;
  decoder.decode(job.position);
  const out = new Float32Array(16 * scene.N * K);
  for (let s = 0; s < scene.N * K; ++s) {
    const row = [0, 1, 2].map((a) => decoder.mean(Math.floor(s / K), s % K, a)), { opacity, cov, color } = decoder;
    const size = cov.subarray(7 * s, 7 * s + 3), turn = cov.subarray(7 * s + 3, 7 * s + 7);
    out.set([...row, opacity[s], ...size, 0, ...turn, ...color.subarray(3 * s, 3 * s + 3), 0], 16 * s);
  }
  writeFileSync(job.out, Buffer.from(out.buffer));
}
"""


def decode_in_node(tmp_path, cases):
    """By case: what the script decodes, what Python does, and the number of anchors."""
    jobs, runs = [], {}
    for case in cases:
        runs[case] = write(tmp_path / f"{case}.html", case)
        settings = settings_of(tmp_path / f"{case}.html")
        position = (np.array(SEEN.pose["position"]) - settings["centre"]).tolist()
        jobs.append(
            {"page": str(tmp_path / f"{case}.html"), "position": position, "out": str(tmp_path / case), "centre": settings["centre"]}
        )
    (tmp_path / "decode.mjs").write_text(PROGRAM.replace("VIEWER", (VIEWER / "live").as_uri()))
    (tmp_path / "jobs").write_text(json.dumps(jobs))
    subprocess.run([NODE, str(tmp_path / "decode.mjs"), str(tmp_path / "jobs")], check=True, capture_output=True, text=True)
    for case, job in zip(cases, jobs):
        found = np.fromfile(job["out"], "<f4").reshape(-1, 16)
        scene = scene_in_page(runs[case], tmp_path / f"{case}.html")
        yield case, found, decoded(scene, SEEN.camera, job["centre"])


@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_the_script_decodes_as_python_does(tmp_path):
    for case, found, wanted in decode_in_node(tmp_path, ["scene-experts"]):
        away, differ = compare(found, wanted)
        assert (wanted[:, 3] > 0).mean() > 0.2 and away < 1e-5 and differ == 0, case


@pytest.mark.slow
@pytest.mark.skipif(NODE is None, reason="node is not installed")
def test_the_script_decodes_every_kind_of_scene_as_python_does(tmp_path):
    for case, found, wanted in decode_in_node(tmp_path, CASES[1:]):
        away, differ = compare(found, wanted)
        assert (wanted[:, 3] > 0).mean() > 0.05 and away < 1e-5 and differ == 0, (case, away, differ)
