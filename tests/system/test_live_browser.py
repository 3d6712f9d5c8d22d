"""The live page in headless Chromium, with WebGPU in software and with WebGL 2 alone: its decode is Python's, its pictures are our
rasteriser's, and it asks for nothing. Pictures are read from the page's own texture: the canvas of a software device shows none."""

import io
import json
import math
import re

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.types import Mode
from scene_experts.files.anchors import live
from scene_experts.render import choose
from scene_experts.view.paint import Look, paint
from support.live_page import CHROMIUM, GL, GPU, TAP, browsers
from support.live_scenes import CASES, STEP, compare, contents_of, decoded, look, make_run, scene_in_page

pytest.importorskip("playwright.sync_api")
pytestmark = [pytest.mark.slow, pytest.mark.foreign, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]
WIDTH, HEIGHT = 320, 240
PLACES = ((0.3, -0.4, -1.0), (2.5, 0.5, 0.0), (-3.0, 1.0, 2.0), (0.5, -2.0, 9.0))
SEEN = [look(place, width=WIDTH, height=HEIGHT) for place in PLACES]
BACKGROUND = (0.2, 0.3, 0.5)
ROUTED = (
    "scaffold-gs",
    "moe-gs",
    "moe-gs-posrouter",
    "moe-gs-balance",
    "margin",
)  # differ in the worker alone, see unit/files/anchors/test_live.py


def write(path, case, **note):
    """A page of a case with the four places as its photographs'. Returns the run and the page's settings."""
    run = make_run(case)
    entries = [seen.pose for seen in SEEN]
    live.write(path, contents_of(run), {"cameras": entries, "nearest": 0.01 / 2.5, "background": BACKGROUND, **note})
    return run, json.loads(re.search(rb'id="settings">(.*?)</script>', path.read_bytes(), re.DOTALL)[1])


def go(page, pose):
    page.tab.evaluate("pose => sceneExperts.page.setPose(pose)", pose)
    page.settle()


def ours(scene, camera):
    """Our picture of a scene from a camera of the trained world, [H, W, 3]."""
    with torch.no_grad():
        rows = scene.select(scene.table, camera, STEP, Mode.DRAW)
        rows = torch.arange(len(scene.table)) if rows is None else rows
        made = scene.finish(scene.decode_composed(rows, camera, STEP), camera, STEP, Mode.DRAW)
        return choose("auto", "cpu")(made.gaussians, camera, torch.tensor(BACKGROUND)).image.clamp(0, 1).numpy()


def psnr(a, b):
    return -10 * np.log10(((a - b) ** 2).mean() + 1e-12)


@pytest.mark.parametrize("flags", [GL, GPU], ids=["WebGL 2", "WebGPU"])
def test_pictures_are_those_of_our_rasteriser(tmp_path, flags):
    """As packed: with halves on WebGPU. Every kind of routing, levels, masks and codes; four places."""
    with browsers(flags, WIDTH, HEIGHT) as make:
        for case in ("moe-gs", "octree-gs"):
            run, settings = write(tmp_path / f"{case}.html", case)
            scene = scene_in_page(run, tmp_path / f"{case}.html")
            page = make().open(tmp_path / f"{case}.html")
            assert page.said == "" and page.renderer == ("WebGPU" if flags is GPU else "WebGL 2")
            for seen, pose in zip(SEEN, settings["poses"]):
                go(page, pose)
                found, wanted = page.picture(BACKGROUND), ours(scene, seen.camera)
                assert wanted.std() > 0.05 and psnr(found, wanted) > 45, (case, psnr(found, wanted))
            assert page.errors == [] and all(request.startswith(("file:", "blob:")) for request in page.requests)
            page.tab.close()


@pytest.mark.parametrize("flags", [GL, GPU], ids=["WebGL 2", "WebGPU"])
def test_experts_are_coloured_off_and_alone_without_a_decode(tmp_path, flags):
    run, settings = write(tmp_path / "a.html", "scene-experts")
    scene, count = scene_in_page(run, tmp_path / "a.html"), len(settings["experts"])
    with browsers(flags, WIDTH, HEIGHT) as make:
        page = make().open(tmp_path / "a.html")
        go(page, settings["poses"][0])
        decodes = "sceneExperts.page.renderer.renderer.decodes ?? String(sceneExperts.page.renderer.at)"
        before, whole = page.tab.evaluate(decodes), page.picture(BACKGROUND)
        page.tab.click("#parts")
        click = lambda *names: [page.tab.click(f"#experts button[aria-label='{name}']") for name in names] and page.settle()  # noqa: E731
        looks = {
            ("expert 2 alone",): Look(only=(1,)),
            ("draw all experts", "expert 1 is drawn"): Look(only=tuple(range(1, count))),
            ("draw all experts", "colour by expert"): Look(show="experts"),
        }
        for names, seen in looks.items():
            click(*names)
            wanted = paint(scene, SEEN[0].camera, STEP, choose("auto", "cpu"), torch.tensor(BACKGROUND), seen).numpy()
            assert psnr(wanted, whole) < 40 and psnr(page.picture(BACKGROUND), wanted) > 45, names
        click("colour by expert")
        assert psnr(page.picture(BACKGROUND), whole) > 90 and page.tab.evaluate(decodes) == before and page.errors == []
        page.tab.close()
        write(tmp_path / "b.html", "scaffold-gs")
        assert not make().open(tmp_path / "b.html").tab.query_selector("#parts")  # one network


@pytest.mark.parametrize("case", [case for case in CASES if case not in ROUTED])
def test_webgpu_decodes_as_python_does(tmp_path, case):
    """With values of 32 bits: every kind of routing and network, levels, codes, masks and the smoothing filter."""
    path = tmp_path / "a.html"
    run, settings = write(path, case)
    path.write_bytes(path.read_bytes().replace(b'"exact": false', b'"exact": true'))
    with browsers(GPU, 64, 48) as make:
        page = make().open(path)
        assert page.renderer == "WebGPU", page.tab.evaluate("sceneExperts.page.renderer.why")
        go(page, settings["poses"][1])
        found, wanted = page.decoded(), decoded(scene_in_page(run, path), SEEN[1].camera, settings["centre"])
        found = found[: len(wanted)].copy()
        found[:, 4:7] *= page.tab.evaluate("sceneExperts.page.renderer.renderer.scene.unit")
        away, differ = compare(found, wanted)
        assert (wanted[:, 3] > 0).mean() > 0.05 and away < 1e-5 and differ == 0, (away, differ)
        assert page.errors == [] and page.tab.evaluate("sceneExperts.page.renderer.renderer.gpu.errors") == []


SORT = """async (sizes) => {
  const { gpu, sorter } = sceneExperts.page.renderer.renderer, out = [];
  for (const n of sizes) {
    const count = gpu.buffer(4, new Uint32Array([n])), blocks = new Uint32Array([Math.max(1, Math.ceil(n / 1024)), 1, 1, 0]);
    const args = gpu.buffer(16, blocks, GPUBufferUsage.STORAGE | GPUBufferUsage.INDIRECT);
    const made = new sorter.constructor(gpu, Math.max(n, 1), count, args), keys = new Uint32Array(n);
    for (let i = 0, state = 12345; i < n; ++i) {
      state = (Math.imul(state, 1664525) + 1013904223) >>> 0;
      keys[i] = (state >>> 8) & (i % 3 ? 0xffffff : 0xff);
    }
    gpu.device.queue.writeBuffer(made.keys, 0, keys);
    gpu.device.queue.writeBuffer(made.ids, 0, Uint32Array.from(keys, (_, i) => i));
    const encoder = gpu.device.createCommandEncoder(), pass = encoder.beginComputePass();
    made.record(pass);
    pass.end();
    gpu.device.queue.submit([encoder.finish()]);
    const found = new Uint32Array(await gpu.read(made.ids)).subarray(0, n);
    const wanted = [...keys.keys()].sort((i, j) => keys[i] - keys[j] || i - j);
    out.push(wanted.reduce((wrong, v, i) => wrong + (v !== found[i]), 0));
  }
  return out;
}"""


def test_the_sort_is_stable_at_the_edges_of_its_blocks_and_frames_are_cheap(tmp_path):
    """A turn of the camera decodes nothing; a frame has at most 24 dispatches and 2 draws; a Gaussian takes about 100 bytes."""
    _, settings = write(tmp_path / "a.html", "scene-experts")
    with browsers(GPU, 64, 48) as make:
        page = make().open(tmp_path / "a.html")
        memory = page.tab.evaluate("[sceneExperts.page.renderer.renderer.gpu.bytes, sceneExperts.page.renderer.renderer.slots]")
        networks = page.tab.evaluate("sceneExperts.page.renderer.renderer.scene.heads.reduce((n, head) => n + head.networks.byteLength, 0)")
        assert (memory[0] - networks) / memory[1] < 105  # of few anchors, whose groups are mostly empty
        assert page.tab.evaluate(SORT, [0, 1, 1023, 1024, 1025, 100_000]) == [0] * 6
        go(page, settings["poses"][0])
        counts = "[counted.dispatches, counted.draws, sceneExperts.page.renderer.renderer.decodes, sceneExperts.page.frames]"
        before = page.tab.evaluate(counts)
        go(page, settings["poses"][2])
        moved = page.tab.evaluate(counts)
        frames = moved[3] - before[3]
        assert moved[2] == before[2] + 1 and moved[0] - before[0] <= 24 * frames and moved[1] - before[1] <= 2 * frames
        turned = {**settings["poses"][2], "rotation": settings["poses"][1]["rotation"]}
        go(page, turned)
        assert page.tab.evaluate(counts)[2] == moved[2]


WRONG = """
const real = GPUDevice.prototype.createShaderModule;
GPUDevice.prototype.createShaderModule = function (given) {
  return real.call(this, { code: given.code.replaceAll(%s) });
};
"""
SMALL = """
const real = GPU.prototype.requestAdapter;
GPU.prototype.requestAdapter = async function () {
  return { limits: { maxBufferSize: 4096, maxStorageBufferBindingSize: 4096 }, requestDevice: () => { throw new Error("not asked for"); } };
};
"""


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (WRONG % '"tanh(", "0.9 * tanh("', "decodes other opacities"),
        (WRONG % '"(keys[i] >> shift)", "(keys[i] >> (shift / 2u))"', "does not sort"),
        (SMALL, "The scene needs 1 MB in one piece"),
    ],
    ids=["wrong numbers", "wrong order", "little memory"],
)
def test_a_device_that_is_wrong_or_small_is_left_aside(tmp_path, change, why):
    _, settings = write(tmp_path / "a.html", "scaffold-gs")
    with browsers(GPU, WIDTH, HEIGHT) as make:
        page = make(change).open(tmp_path / "a.html")
        assert page.renderer == "WebGL 2" and why in page.tab.evaluate("sceneExperts.page.renderer.why") and page.said == ""
        go(page, settings["poses"][0])
        assert page.picture(BACKGROUND).std() > 0.05


def test_a_device_that_goes_away_is_replaced(tmp_path):
    """WebGL 2 goes on where WebGPU ended."""
    _, settings = write(tmp_path / "a.html", "scaffold-gs")
    with browsers(GPU, WIDTH, HEIGHT) as make:
        page = make().open(tmp_path / "a.html")
        go(page, settings["poses"][0])
        before = page.picture(BACKGROUND)
        page.tab.evaluate("sceneExperts.page.lose()")
        page.tab.wait_for_function("sceneExperts.page.renderer?.name === 'WebGL 2'")
        go(page, settings["poses"][0])
        assert psnr(page.picture(BACKGROUND), before) > 40 and page.said == ""


def test_the_page_moves_by_hands_keys_links_and_its_list(tmp_path):
    _, settings = write(tmp_path / "a.html", "scaffold-gs")
    with browsers(GL, WIDTH, HEIGHT) as make:
        page = make().open(tmp_path / "a.html")
        tab, place = page.tab, lambda: np.array(page.tab.evaluate("sceneExperts.page.pose().position"))
        turn = lambda: np.array(tab.evaluate("sceneExperts.page.pose().rotation"))  # noqa: E731
        page.settle()
        first, rotation = place(), turn()
        np.testing.assert_allclose(first, settings["pose"]["position"], atol=1e-6)
        tab.mouse.move(160, 100)
        tab.mouse.down()
        tab.mouse.move(190, 100)
        tab.mouse.up()
        page.settle()
        target = lambda p, r: p + settings["distance"] * r[:, 2]  # noqa: E731
        np.testing.assert_allclose(target(place(), turn()), target(first, rotation), atol=1e-6)  # it turned around what it looks at
        assert np.abs(turn() - rotation).max() > 0.01 and np.abs(turn() @ turn().T - np.eye(3)).max() < 1e-9
        before = place()
        tab.mouse.wheel(0, -300)
        page.settle()
        assert np.linalg.norm(place() - before) > 0.01
        before = place()
        tab.evaluate(TAP)
        page.settle()
        assert 0.9 < np.dot(place() - before, turn()[:, 2]) / (0.3 * settings["speed"]) < 2  # it flew ahead for as long as the key was held
        tab.keyboard.press("r")
        tab.wait_for_timeout(1500)
        page.settle()
        np.testing.assert_allclose(place(), first, atol=1e-6)
        tab.click("#places")
        tab.click("#list button:nth-child(3)")
        tab.wait_for_timeout(1500)
        page.settle()
        np.testing.assert_allclose(place(), settings["poses"][2]["position"], atol=1e-6)
        tab.keyboard.press("l")
        assert "position=" in tab.evaluate("location.hash")
        written = [float(v) for v in re.search("position=([^&]*)", tab.evaluate("location.hash"))[1].split(",")]
        there = np.array(SEEN[2].pose["position"])  # of the capture, as are links and what a script gives and gets
        np.testing.assert_allclose([written, tab.evaluate("sceneExperts.pose().position")], [there, there], atol=1e-5)
        tab.evaluate("pose => sceneExperts.setPose(pose)", SEEN[1].pose)
        np.testing.assert_allclose(place(), settings["poses"][1]["position"], atol=1e-6)
        seen = tab.evaluate("[location.href, sceneExperts.page.shown, innerWidth / innerHeight]")
        link = ",".join(map(str, first + settings["centre"]))
        tab.evaluate(f"location.hash = 'position={link}&rotation={','.join(map(str, rotation.ravel()))}&fov=50'")
        tab.wait_for_timeout(300)
        np.testing.assert_allclose(place(), first, atol=1e-6)
        tab.evaluate("location.hash = ''")  # back to an address without a view
        tab.wait_for_timeout(1500)
        page.settle()
        np.testing.assert_allclose(place(), first, atol=1e-6)
        for wrong in (
            "{position: [NaN, 0, 0], rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]}",
            "{position: [0, 0, 0], rotation: Array(9).fill(0)}",
            "",
        ):
            assert "expected a pose" in tab.evaluate(
                f"(() => {{ try {{ sceneExperts.setPose({wrong}) }} catch (e) {{ return e.message }} }})()"
            )
        tab.evaluate("location.hash = 'position=,,&rotation=0,0,0,0,0,0,0,0,0'")
        page.settle()
        np.testing.assert_allclose(place(), first, atol=1e-6)
        for size in ((WIDTH, HEIGHT), (HEIGHT, WIDTH), (3 * WIDTH, HEIGHT)):  # all of the sender's view, on a screen of any form
            other = make()
            other.tab.set_viewport_size({"width": size[0], "height": size[1]})
            other.tab.goto(seen[0])
            other.tab.wait_for_function("window.sceneExperts?.page.renderer")
            shown, aspect = other.tab.evaluate("[sceneExperts.page.shown, innerWidth / innerHeight]")
            tall, wide = (math.tan(math.radians(shown / 2)) / math.tan(math.radians(seen[1] / 2)) * k for k in (1, aspect / seen[2]))
            assert min(tall, wide) == pytest.approx(1, abs=1e-3)
            other.tab.close()
        tab.keyboard.press("h")
        assert tab.is_visible("#help") and not tab.is_visible("#list")
        tab.keyboard.press("Escape")
        assert not tab.is_visible("#help") and page.errors == []


def test_the_first_view_is_that_of_the_screen(tmp_path):
    """The one of the nearest aspect, cut to the screen; it stays so when a phone is turned."""
    fov = {"wide": 40.0, "high": 60.0}
    entries = [
        {**SEEN[2].pose, "fov": fov["wide"], "width": 16, "height": 9},
        {**SEEN[3].pose, "fov": fov["high"], "width": 9, "height": 19},
    ]
    _, settings = write(tmp_path / "a.html", "scaffold-gs", first=entries)
    with browsers(GL, 640, 360) as make:
        page = make().open(tmp_path / "a.html")
        shown = lambda: page.tab.evaluate("[sceneExperts.page.shown, sceneExperts.page.veil.style.getPropertyValue('--edge')]")  # noqa: E731
        place = lambda: page.tab.evaluate("sceneExperts.page.pose().position")  # noqa: E731

        def turn(width, height):
            page.tab.set_viewport_size({"width": width, "height": height})
            page.tab.wait_for_function(f"sceneExperts.page.canvas.width === {width}")
            page.settle()

        page.settle()
        np.testing.assert_allclose(place(), settings["first"][0]["position"], atol=1e-9)
        assert shown() == [pytest.approx(40, abs=1e-6), "0.00%"]
        turn(300, 760)
        np.testing.assert_allclose(place(), settings["first"][1]["position"], atol=1e-9)
        assert shown() == [pytest.approx(60, abs=1e-6), "0.00%"]  # a narrower screen shows less of the width
        turn(800, 360)
        wide = np.tan(np.radians(shown()[0] / 2)) * 800 / 360
        assert wide == pytest.approx(np.tan(np.radians(20)) * 16 / 9)  # a wider one less of the height


def test_a_photograph_fades_in_at_its_place_and_goes_when_the_camera_moves(tmp_path):
    stream = io.BytesIO()
    Image.new("RGB", (32, 24), (200, 30, 30)).save(stream, "WEBP")
    write(tmp_path / "a.html", "scaffold-gs", pictures=[b"", stream.getvalue(), b"", b""])
    with browsers(GL, WIDTH, HEIGHT) as make:
        page = make().open(tmp_path / "a.html")
        image, shown = page.tab.locator("main > img"), "document.querySelector('main > img').style.opacity"
        page.settle()
        assert page.tab.evaluate(shown) == "0"
        page.tab.click("#places")
        page.tab.click("#list button:nth-child(2)")
        page.tab.wait_for_function(f"{shown} === '1'")
        box = image.bounding_box()
        np.testing.assert_allclose([box["x"], box["y"], box["width"], box["height"]], [0, 0, WIDTH, HEIGHT], atol=0.5)
        page.tab.mouse.move(160, 60)
        page.tab.mouse.down()
        page.tab.mouse.move(190, 60)
        page.tab.mouse.up()
        assert page.tab.evaluate(shown) == "0" and page.errors == []
        assert all(request.startswith(("file:", "blob:", "data:")) for request in page.requests)


def test_flight_and_jumps_follow_the_clock(tmp_path):
    """As far in one long frame as in many short ones."""
    _, settings = write(tmp_path / "a.html", "scaffold-gs", flight=[seen.pose for seen in SEEN])
    move = """([name, steps, seconds]) => {
      const page = sceneExperts.page;
      page.running = true; // frames are made here
      page.setPose(page.settings.poses[0]);
      if (name === "flight") page.flight = 0;
      else if (name === "jump") page.flyTo(page.settings.poses[2]);
      else page.camera.ask("spin", [0.5, 0.1]);
      for (let i = 0; i < steps; ++i) page.move(seconds / steps);
      return page.pose().position;
    }"""
    with browsers(GL, WIDTH, HEIGHT) as make:
        page = make().open(tmp_path / "a.html")
        page.settle()
        for name, seconds in (("flight", 5.3), ("jump", 0.7), ("jump", 2.0), ("hands", 0.3)):
            few, many = (page.tab.evaluate(move, [name, steps, seconds]) for steps in (1, 300))
            np.testing.assert_allclose(few, many, atol=1e-6 if name != "hands" else 0.02)
            assert np.abs(np.array(few) - settings["poses"][0]["position"]).max() > 0.01


def test_a_damaged_file_is_one_sentence_on_the_page(tmp_path):
    write(tmp_path / "a.html", "scaffold-gs")
    page = (tmp_path / "a.html").read_text()
    start, scene, rest = re.split(r'(?<=id="scene">)([^<]*)', page, maxsplit=1)
    with browsers(GL, WIDTH, HEIGHT) as make:
        for i, broken in enumerate((scene[: 4 * (len(scene) // 8)], "", "?" + scene[1:])):
            (tmp_path / f"{i}.html").write_text(start + broken + rest)
            said = make().open(tmp_path / f"{i}.html").said
            assert said.startswith("The scene could not be shown: expected a compact file") and said.count(".") <= 1, said
