"""The streamed page in headless Chromium, from a plain server of files: what is shown while parts are late, missing or damaged."""

import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import quote

import numpy as np
import pytest
import torch

from scene_experts.core.types import Mode
from scene_experts.files.anchors import layers, streamed
from scene_experts.files.anchors.coarse import Layered
from scene_experts.files.anchors.precision import from_spread
from scene_experts.files.anchors.read import scene as scene_of
from scene_experts.files.anchors.rounding import rounded
from scene_experts.render import choose
from support.layers import make_coarse
from support.live_page import CHROMIUM, GL, GPU, browsers
from support.live_scenes import STEP, WORLD, contents_of, look, make_run

pytest.importorskip("playwright.sync_api")
pytestmark = [pytest.mark.slow, pytest.mark.foreign, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]
WIDTH, HEIGHT = 320, 240
SEEN = look((0.3, -0.4, -1.0), width=WIDTH, height=HEIGHT)
BACKGROUND = (0.2, 0.3, 0.5)
LINE = "(line => !line || line.hidden ? '' : line.firstChild.textContent)(document.getElementById('progress'))"

COUNT_EMPTY = """window.empty = 0; // how often a renderer on WebGPU had no picture
setInterval(() => { const { name, renderer } = sceneExperts.page.renderer; window.empty += name === "WebGPU" && !renderer.texture; }, 1);"""


@contextmanager
def serving(folder):
    """A server of a folder and its address. Requests that begin with a name in `held` wait until it is taken out."""
    held = set()

    class Handler(SimpleHTTPRequestHandler):
        def do_GET(self):
            while any(self.path.rpartition("/")[2].startswith(name) for name in held):
                time.sleep(0.02)
            super().do_GET()

        def log_message(self, *_):
            pass

    class Server(ThreadingHTTPServer):
        def handle_error(self, *_):
            pass  # the page went away

    server = Server(("127.0.0.1", 0), partial(Handler, directory=str(folder)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}", held
    finally:
        held.clear()
        server.shutdown()
        server.server_close()


def write(folder, monkeypatch, case="octree-gs", name="index.html"):
    """A page of four chunks or more. Returns the whole scene and the coarse one, as `picture` draws them."""
    monkeypatch.setattr(layers, "ANCHORS", 40)
    (folder / "favicon.ico").touch()  # browsers ask servers for it
    run = make_run(case)
    data = contents_of(run)
    data = replace(data, precision=from_spread(data.columns, data.networks))
    rows, coarse = make_coarse(data)
    note = {"cameras": [SEEN.pose, look((2.5, 0.5, 0.0)).pose], "nearest": 0.01 / 2.5, "background": BACKGROUND}
    streamed.write(folder / name, Layered(data, rows, coarse, torch.ones(len(data.columns["xyz"]))), note)
    return scene_of(run, streamed.read(folder / name), WORLD)[0], scene_of(run, rounded(coarse, coarse.precision), WORLD)[0]


def picture(scene):
    with torch.no_grad():
        rows = scene.select(scene.table, SEEN.camera, STEP, Mode.DRAW)
        rows = torch.arange(len(scene.table)) if rows is None else rows
        made = scene.finish(scene.decode_composed(rows, SEEN.camera, STEP), SEEN.camera, STEP, Mode.DRAW)
        return choose("auto", "cpu")(made.gaussians, SEEN.camera, torch.tensor(BACKGROUND)).image.clamp(0, 1).numpy()


def psnr(a, b):
    return -10 * np.log10(((a - b) ** 2).mean() + 1e-12)


def go(page, address, name="index.html"):
    page.tab.set_default_timeout(300_000)
    page.tab.goto(f"{address}/{quote(name)}")
    page.tab.wait_for_function("window.sceneExperts?.page.renderer || /^The scene/.test(document.getElementById('note').textContent)")


def rest(page):
    """Wait until nothing moves, whatever is still on its way."""
    page.tab.wait_for_function("!sceneExperts.page.running && sceneExperts.page.renderer.isFinal")


@pytest.mark.parametrize("flags", [GL, GPU], ids=["WebGL 2", "WebGPU"])
def test_the_coarse_scene_is_shown_while_the_rest_is_late(tmp_path, monkeypatch, flags):
    whole, coarse = write(tmp_path, monkeypatch)
    with serving(tmp_path) as (address, held), browsers(flags, WIDTH, HEIGHT) as make:
        held.update({"plan", "02"})
        page = make()
        go(page, address)
        page.tab.evaluate(COUNT_EMPTY)
        rest(page)
        assert page.said == "" and "%" in page.tab.evaluate(LINE) and page.renderer == ("WebGPU" if flags is GPU else "WebGL 2")
        shown = page.picture(BACKGROUND)
        assert psnr(shown, picture(coarse)) > 45 and psnr(shown, picture(whole)) < 40
        page.tab.evaluate("sceneExperts.page.setPose(sceneExperts.page.settings.poses[1])")  # one can move in it
        rest(page)
        assert psnr(page.picture(BACKGROUND), shown) < 60
        page.tab.evaluate("sceneExperts.page.setPose(sceneExperts.page.settings.poses[0])")
        held.remove("plan")
        page.tab.wait_for_function("sceneExperts.page.parts === 2")
        rest(page)
        between = page.picture(BACKGROUND)
        assert psnr(between, picture(whole)) < 60
        held.clear()
        page.settle()
        assert psnr(page.picture(BACKGROUND), picture(whole)) > 45 and page.tab.evaluate(LINE) == "" and page.errors == []
        assert all(request.startswith((address, "blob:")) for request in page.requests)
        assert page.tab.evaluate("sceneExperts.page.parts + 2 === sceneExperts.page.settings.parts.length && empty === 0")


def test_a_missing_or_damaged_part_is_a_sentence_and_what_is_here_stays(tmp_path, monkeypatch):
    whole, coarse = write(tmp_path, monkeypatch, "scene-experts")
    folder = tmp_path / "index.parts"
    third = next(folder.glob("01-*"))
    content = third.read_bytes()
    with serving(tmp_path) as (address, _), browsers(GL, WIDTH, HEIGHT) as make:
        for broken, why in (
            (None, "404"),
            (content[:-9], f"{len(content) - 9} bytes in place of {len(content)}"),
            (content[:-9] + b"123456789", "another export"),
            (content + b"1", "more than"),
        ):
            third.unlink() if broken is None else third.write_bytes(broken)
            page = make()
            go(page, address)
            page.settle()
            line = page.tab.evaluate(LINE)
            assert line.startswith("The rest of the scene is missing (") and why in line and third.name in line and page.said == ""
            assert page.tab.evaluate("sceneExperts.page.parts") == 1
            assert psnr(page.picture(BACKGROUND), picture(coarse)) > 5 and psnr(page.picture(BACKGROUND), picture(whole)) < 60
            third.write_bytes(content)
            page.tab.click("#progress button")
            page.tab.wait_for_function("sceneExperts.page.parts + 2 === sceneExperts.page.settings.parts.length")
            rest(page)
            assert psnr(page.picture(BACKGROUND), picture(whole)) > 45
            page.tab.close()


def test_a_page_of_any_name_finds_its_parts(tmp_path, monkeypatch):
    write(tmp_path, monkeypatch, "scaffold-gs", "a scene #1, 50 %?.html")
    with serving(tmp_path) as (address, _), browsers(GL, WIDTH, HEIGHT) as make:
        page = make()
        go(page, address, "a scene #1, 50 %?.html")
        page.settle()
        assert page.said == page.tab.evaluate(LINE) == "" and page.errors == []


def test_without_its_coarse_scene_or_from_disk_the_page_says_why(tmp_path, monkeypatch):
    write(tmp_path, monkeypatch, "scaffold-gs")
    with serving(tmp_path) as (address, _), browsers(GL, WIDTH, HEIGHT) as make:
        page = make().open(tmp_path / "index.html")
        assert "serve its folder" in page.said
        next((tmp_path / "index.parts").glob("coarse-*")).unlink()
        page = make()
        go(page, address)
        assert page.said.startswith("The scene could not be shown: the server answered 404 for coarse-")
