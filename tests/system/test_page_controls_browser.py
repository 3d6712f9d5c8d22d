"""Every control of both kinds of exported page, in headless Chromium: buttons, keys, full screen, links, and a page inside a frame."""

import html as text
import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from scene_experts.files.anchors import live
from scene_experts.files.formats import html
from support.live_page import CHROMIUM, GL, browsers
from support.live_scenes import contents_of, look, make_run
from support.splat_quanta import scene

pytest.importorskip("playwright.sync_api")
pytestmark = [pytest.mark.slow, pytest.mark.foreign, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]
WIDTH, HEIGHT = 480, 240
BROKEN = "#position=,,&rotation=0,0,0,0,0,0,0,0,0"
READY = "window.sceneExperts?.page.renderer && document.getElementById('note').hidden"
SAID = "document.getElementById('note').hidden ? '' : document.getElementById('note').textContent"


def write(path, kind, origin=None):
    """A page with three places of photographs and a flight. origin: Of its file in the capture's frame."""
    places = [look(place, width=WIDTH, height=HEIGHT).pose for place in ((0.3, -0.4, -1.0), (2.5, 0.5, 0.0), (-2.0, 0.3, 1.0))]
    note, about = {"cameras": places, "flight": places}, {} if origin is None else {"origin": list(origin)}
    if kind == "live":
        data = contents_of(make_run("scaffold-gs"))
        live.write(path, replace(data, about={**data.about, **about}), {**note, "nearest": 0.01})
    else:
        html.write(path, scene(100, 1), note | about)
    return path


@pytest.fixture(params=["live", "baked"])
def page(request, tmp_path):
    """An open page that has drawn its scene, and its path."""
    path = write(tmp_path / "a.html", request.param)
    with browsers(GL, WIDTH, HEIGHT) as make:
        made = make().open(path)
        made.tab.wait_for_function(READY)
        made.tab.set_default_timeout(60_000)
        yield made, path


def test_each_button_and_key_acts_without_an_error(page):
    made, _ = page
    tab = made.tab
    shown = tab.evaluate("[...document.querySelectorAll('#bar button')].filter((b) => !b.hidden).map((b) => b.id)")
    assert {"home", "previous", "next", "flight", "whole", "ask"} <= set(shown)
    for _ in range(2):  # the second time takes back what the first did
        for name in shown:
            tab.click(f"#{name}")
    for key in ("r", "[", "]", "p", "p", "h", "Escape", "w", "q", "ArrowLeft", "l"):
        tab.keyboard.press(key)
    assert "position=" in tab.evaluate("location.hash") and made.errors == []


def test_full_screen_comes_and_goes(page):
    made, _ = page
    tab = made.tab
    for act in (lambda: tab.click("#whole"), lambda: tab.keyboard.press("f")):
        act()
        tab.wait_for_function("document.fullscreenElement !== null")
        act()
        tab.wait_for_function("document.fullscreenElement === null")
    assert made.errors == []


def test_a_link_without_a_view_is_told_until_somebody_acts(page):
    made, path = page
    tab = made.tab
    before = tab.evaluate("sceneExperts.pose().position")
    for start in (lambda: tab.evaluate(f"location.hash = '{BROKEN}'"), lambda: (tab.goto("about:blank"), tab.goto(path.as_uri() + BROKEN))):
        start()
        tab.wait_for_function(
            f"window.sceneExperts?.page.renderer && ({SAID}).startsWith('The link has no view of this scene: expected a pose')"
        )
        tab.evaluate("sceneExperts.settled()")
        np.testing.assert_allclose(tab.evaluate("sceneExperts.pose().position"), before, atol=1e-6)
        assert "The link has no view" in made.said
        tab.keyboard.press("]")
        assert made.said == "" and made.errors == []


@pytest.mark.parametrize("kind", ["live", "baked"])
def test_poses_of_a_far_capture_are_the_capture_s(tmp_path, kind):
    """Its file is relative to a place of whole numbers; links and scripts are not."""
    far = (448250.0, 5411932.0, 340.0)
    path, pose = write(tmp_path / "a.html", kind, far), look((2.5, 0.5, 0.0), width=WIDTH, height=HEIGHT).pose
    there = [a + b for a, b in zip(pose["position"], far)]
    with browsers(GL, WIDTH, HEIGHT) as make:
        tab = make().open(path).tab
        tab.wait_for_function(READY)
        tab.keyboard.press("]")
        tab.wait_for_timeout(1500)
        tab.evaluate("sceneExperts.settled()")
        np.testing.assert_allclose(tab.evaluate("sceneExperts.pose().position"), there, atol=1e-3)
        tab.keyboard.press("l")
        written = tab.evaluate("new URLSearchParams(location.hash.slice(1)).get('position').split(',').map(Number)")
        np.testing.assert_allclose(written, there, atol=1e-3)
        tab.evaluate("pose => sceneExperts.setPose(pose)", {**pose, "position": there})
        np.testing.assert_allclose(tab.evaluate("sceneExperts.pose().position"), there, atol=1e-6)


def test_the_page_says_that_it_unpacks(tmp_path):
    path = write(tmp_path / "a.html", "live")
    with browsers(GL, WIDTH, HEIGHT) as make:
        made = make("window.Worker = class { postMessage() {} };")  # one that never answers
        made.tab.goto(path.as_uri())
        made.tab.wait_for_function("window.sceneExperts")
        assert made.said.startswith("unpacking ")


@pytest.mark.parametrize("kind", ["live", "baked"])
def test_a_page_that_is_cut_short_says_so(tmp_path, kind):
    path = write(tmp_path / "a.html", kind)
    whole = path.read_bytes()
    with browsers(GL, WIDTH, HEIGHT) as make:
        for end in (whole.index(b'id="scene">') + 200, whole.index(b'id="code">') + 200, whole.rindex(b"</script>")):
            path.write_bytes(whole[:end])
            made = make()
            made.tab.goto(path.as_uri())
            made.tab.wait_for_function(f"{SAID}.includes('cut short')")
            assert made.tab.is_hidden("#bar")


@pytest.mark.parametrize("allowed", [True, False])
def test_a_page_that_is_the_text_of_a_frame(page, tmp_path, allowed):
    """As notebooks show it: key L writes into the frame's own address, and full screen has a button where the outer page allows it."""
    made, path = page
    outer = tmp_path / "outer.html"
    allow = "*" if allowed else "'none'"
    outer.write_text(
        f'<iframe style="width:95vw;height:90vh" allow="fullscreen {allow}" srcdoc="{text.escape(path.read_text("utf8"))}"></iframe>',
        "utf8",
    )
    made.tab.goto(outer.as_uri())
    frame = made.tab.frames[1]
    frame.wait_for_function(READY)
    frame.evaluate("sceneExperts.settled()")
    assert np.asarray(Image.open(io.BytesIO(made.tab.screenshot())).convert("L")).std() > 5
    assert frame.is_visible("#whole") == allowed
    frame.click("#next")
    made.tab.keyboard.press("l")
    made.tab.keyboard.press("f")
    frame.wait_for_function("location.hash.startsWith('#position=')")
    assert frame.evaluate("document.fullscreenElement !== null") == allowed and made.errors == []


def test_the_bar_and_the_help_fit_a_phone(page):
    made, _ = page
    tab = made.tab
    tab.set_viewport_size({"width": 300, "height": 500})
    tab.click("#ask")
    box = "(e) => { const r = e.getBoundingClientRect(); return [r.left, r.top, r.right, r.bottom]; }"
    buttons = tab.evaluate(f"[...document.querySelectorAll('#bar button')].filter((b) => !b.hidden).map({box})")
    left, top, right, bottom = tab.evaluate(f"({box})(document.getElementById('help'))")
    assert left >= 0 and right <= 300 and top >= 0 and bottom <= min(b[1] for b in buttons)
    assert all(b[0] >= 0 and b[2] <= 300 and b[3] <= 500 for b in buttons)
    assert max(b[3] - b[1] for b in buttons) < 1.5 * min(b[3] - b[1] for b in buttons)  # no text in two lines


def test_keys_go_by_their_letters_and_do_not_repeat(page):
    made, _ = page
    tab = made.tab
    tab.evaluate("window.flown = 0; window.sceneExperts.page.flyAround = () => { window.flown += 1; }; 0")
    send = "([key, code, more]) => dispatchEvent(new KeyboardEvent('keydown', { key, code, ...more }))"
    tab.evaluate(send, ["p", "KeyR", {}])  # a Dvorak keyboard
    tab.evaluate(send, ["l", "KeyP", {}])
    tab.evaluate(send, ["p", "KeyR", {"repeat": True}])
    assert tab.evaluate("window.flown") == 1
    tab.evaluate("window.stepped = []; window.sceneExperts.page.step = (by) => { window.stepped.push(by); }; 0")
    tab.evaluate(send, ["]", "Digit9", {"ctrlKey": True, "altKey": True}])  # AltGr of a German keyboard
    tab.evaluate(send, ["[", "BracketLeft", {}])
    tab.evaluate(send, ["]", "BracketRight", {"metaKey": True}])  # forward, of the browser
    assert tab.evaluate("window.stepped") == [1, -1] and made.errors == []


def test_lost_graphics_come_back(tmp_path):
    path = write(tmp_path / "a.html", "live")
    with browsers(GL, WIDTH, HEIGHT) as make:
        made = make().open(path)
        tab = made.tab
        tab.wait_for_function(READY)
        tab.evaluate("window.lost = document.querySelector('canvas').getContext('webgl2').getExtension('WEBGL_lose_context')")
        tab.evaluate("window.lost.loseContext()")
        tab.mouse.move(200, 100)
        tab.mouse.down()
        tab.mouse.move(240, 110, steps=4)
        tab.mouse.up()
        tab.wait_for_timeout(500)
        assert "took the graphics away" in tab.evaluate(SAID)
        tab.evaluate("window.lost.restoreContext()")
        tab.wait_for_function(READY)
        assert made.errors == []


def test_staying_near_photographs_does_not_tip_the_picture_over(tmp_path):
    with browsers(GL, WIDTH, HEIGHT) as make:
        made = make().open(write(tmp_path / "a.html", "live"))
        tab = made.tab
        tab.wait_for_function(READY)
        found = tab.evaluate("""() => {
          const { camera, settings } = window.sceneExperts.page;
          const tilt = () => Math.abs(camera.rotation.reduce((sum, row, i) => sum + row[0] * camera.up[i], 0));
          camera.set(settings.poses[0]);
          for (let i = 0; i < 30; i++) camera.orbit([0, 0.02]);
          const before = tilt(), place = [...camera.position];
          for (let i = 0; i < 60; i++) { camera.orbit([0.05, 0]); camera.moveTo(place); }
          return [before, tilt()];
        }""")
        assert abs(found[1] - found[0]) < 0.02
        side = tab.evaluate("""() => {
          const { camera } = window.sceneExperts.page, moves = [], { up } = camera;
          const seen = (point) => {
            const away = point.map((v, i) => v - camera.position[i]);
            const at = [0, 1, 2].map((j) => away.reduce((sum, v, i) => sum + v * camera.rotation[i][j], 0));
            return [at[0] / at[2], at[1] / at[2]];
          };
          const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
          const unit = (a) => a.map((v) => v / Math.hypot(...a)), back = (a) => a.map((v) => -v);
          const ahead = unit(cross(up, Math.abs(up[0]) < 0.9 ? [1, 0, 0] : [0, 1, 0])), level = unit(cross(ahead, up));
          const turned = [[level, back(up)], [up, level], [back(up), back(level)], [back(level), up]];
          for (const [x, y] of turned) for (const spin of [[-0.1, 0], [0, -0.1]]) {
            camera.set({ position: [0, 0, 0], rotation: [0, 1, 2].map((i) => [x[i], y[i], ahead[i]]) });
            const near = ahead.map((v) => 0.7 * camera.distance * v), from = seen(near);
            camera.orbit(spin);
            const to = seen(near);
            moves.push([to[0] - from[0], to[1] - from[1], ...spin]);
          }
          return moves;
        }""")
        for right, down, asked, below in side:  # the hand moves against what is asked of the camera; what is near goes with it
            assert (right > 0.02 and abs(down) < 0.005) if asked else (down > 0.02 and abs(right) < 0.005), (right, down, asked, below)


def test_a_tilted_photograph_of_a_baked_page_comes_level_by_and_by(tmp_path):
    with browsers(GL, WIDTH, HEIGHT) as make:
        made = make().open(write(tmp_path / "a.html", "baked"))
        tab = made.tab
        tab.wait_for_function(READY)
        tilt = 0.6  # radians
        found = tab.evaluate(f"""async () => {{
          const {{ page }} = window.sceneExperts, camera = page.camera, frame = page.frame;
          const right = () => camera.up.clone().set(1, 0, 0).applyQuaternion(camera.quaternion).dot(camera.up);
          page.home();
          camera.lookAt(page.controls.target);
          camera.rotateZ({tilt});
          page.take();
          const tilts = [];
          page.frame = () => {{ frame.call(page); tilts.push(right()); }};
          page.last = performance.now() - 10;
          page.frame();
          await window.sceneExperts.settled();
          return tilts;
        }}""")
        level = found[0] / np.sin(0.6 * np.exp(-0.08))  # of the axis that was turned, which need not be at right angles to the vertical
        assert 0.7 < level <= 1.05 and abs(found[-1]) < 2e-3 and max(found) == found[0] and len(found) > 3
        assert made.errors == []
