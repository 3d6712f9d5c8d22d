"""The viewer in a real browser (headless Chromium through playwright, where both are there): the scene is on the page, controls change it,
clients that come and go leave nothing behind, and a socket that sends nonsense harms nobody."""

import io
import shutil
import threading
import time

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.evaluate.pictures import to_8bit
from scene_experts.view.paint import paint
from support.viewers import DRAW

playwright = pytest.importorskip("playwright.sync_api")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
pytestmark = [pytest.mark.foreign, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PART = np.s_[200:500, 330:610]  # between the notification and the panel


@pytest.fixture
def browser():
    with playwright.sync_playwright() as p:
        made = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield made
        made.close()


def settled(page, viewer, seconds=120.0) -> np.ndarray:
    """A screenshot once the client has its full picture, and the page, on a busy machine too, shows it."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and not (viewer.clients and all(c.full for c in viewer.clients.values())):
        page.wait_for_timeout(200)
    take = lambda: np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))  # noqa: E731
    page.wait_for_timeout(2500)
    before, shot = None, take()
    done = lambda: before is not None and np.array_equal(before, shot) and shot[PART].std() > 1  # noqa: E731
    while time.monotonic() < end and not done():  # the page fades pictures in
        page.wait_for_timeout(1500)
        before, shot = shot, take()
    return shot


def test_the_page_shows_our_own_render_and_follows_the_controls(serving, browser, capture):
    page = browser.new_page(viewport={"width": 960, "height": 540})
    page.goto(serving.url)
    shot = settled(page, serving)
    (client,) = serving.clients.values()
    scene, step = serving.current()
    camera = serving.read_camera(client)
    picture = to_8bit(paint(scene, camera, step, DRAW, torch.tensor(serving.panel.read_background())))
    picture = np.asarray(Image.fromarray(picture).resize((960, 540), Image.Resampling.BILINEAR))
    error = ((shot[PART].astype(float) - picture[PART]) ** 2).mean()
    assert picture[PART].std() > 5 and 10 * np.log10(255**2 / error) > 22
    serving.panel.show.value = "experts"
    page.wait_for_timeout(500)
    differs = lambda: np.abs(settled(page, serving)[PART].astype(int) - shot[PART]).mean() > 3  # noqa: E731
    assert any(differs() for _ in range(5))  # on a busy machine the page is late


def test_clients_come_and_go_and_nonsense_harms_nobody(serving, browser):
    websockets = pytest.importorskip("websockets.sync.client")
    protocol = f"viser-v{pytest.importorskip('viser').__version__}"
    before = threading.active_count()
    for _ in range(10):
        page = browser.new_page()
        page.goto(serving.url)
        page.wait_for_timeout(300)
        page.close()
    for message in (b"\xff\x00nonsense", b"", "text"):
        try:
            with websockets.connect(serving.url.replace("http", "ws"), subprotocols=[protocol], open_timeout=5) as socket:
                socket.send(message)
        except Exception:  # being refused is fine
            pass
    end = time.monotonic() + 20
    while serving.clients and time.monotonic() < end:
        time.sleep(0.2)
    assert serving.clients == {} and threading.active_count() <= before + 4
    page = browser.new_page()
    page.goto(serving.url)
    settled(page, serving)
    assert len(serving.clients) == 1
