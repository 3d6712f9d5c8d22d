"""The page: one file that fetches nothing, starts where the note says, and shows in headless Chromium what our rasteriser draws."""

import gzip
import hashlib
import io
import json
import math
import re
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Gaussians
from scene_experts.data.views import View, World
from scene_experts.files.formats import html
from scene_experts.files.formats.html import page_settings, read, view_note, write
from scene_experts.files.formats.pack import scaled
from scene_experts.files.formats.splats import Splats
from scene_experts.geometry.rotation import quat_to_matrix
from scene_experts.geometry.sh import sh_to_rgb
from scene_experts.render.reference import ReferenceRasterizer
from support.live_page import TAP
from support.messages import naming
from support.splat_quanta import check, scene

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
WITHOUT = "--disable-3d-apis"  # no WebGL
WIDTH, HEIGHT, FOV = 320, 240, 50.0
BACKGROUND = (0.2, 0.3, 0.5)


def pose(seed=3, away=4.0):
    """A camera that looks at the origin from anywhere, rolled."""
    R = quat_to_matrix(torch.nn.functional.normalize(torch.randn(4, generator=torch.Generator().manual_seed(seed)), dim=0)).double()
    return {"position": (-away * R[:, 2]).tolist(), "rotation": R.tolist(), "fov": FOV}


def blobs(n=300):
    """Soft Gaussians around the origin whose colours change with the view."""
    s = scene(n, 3, seed=5, size=0.7)
    return Splats(s.means, s.log_scales * 0.3 - 1.6, s.quats, s.opacity_logit, s.sh)


def ours(s, entry):
    """Our picture of the pose, [H, W, 3] in 8 bits."""
    rotation, position = torch.tensor(entry["rotation"]), torch.tensor(entry["position"])
    world_to_cam = torch.eye(4)
    world_to_cam[:3, :3], world_to_cam[:3, 3] = rotation.T, -rotation.T @ position
    f = HEIGHT / 2 / math.tan(math.radians(FOV / 2))
    camera = Camera(world_to_cam, torch.tensor([[f, 0, WIDTH / 2], [0, f, HEIGHT / 2], [0, 0, 1]]), WIDTH, HEIGHT, id=0)
    colors = sh_to_rgb(s.sh, s.means - position, s.degree)
    quats = torch.nn.functional.normalize(s.quats, dim=1)
    gaussians = Gaussians(s.means, quats, s.log_scales.exp(), s.opacity_logit.sigmoid(), colors, torch.arange(len(s)))
    image = ReferenceRasterizer()(gaussians, camera, torch.tensor(BACKGROUND)).image
    return (image.clamp(0, 1) * 255).round().byte().numpy()


SETTINGS = b'<script type="application/json" id="settings">'


@pytest.mark.parametrize("page", [b"", SETTINGS, SETTINGS + b'{"antialias": 1}</script>', SETTINGS + b"{}</script>"])
def test_settings_that_say_nothing_of_antialiasing(tmp_path, page):
    (tmp_path / "a.html").write_bytes(page)
    assert html.is_antialiased(tmp_path / "a.html") is False


@pytest.mark.parametrize("settings", [b"{broken", b"[true]", b"[" * 10_000, b'{"unit": 0}', b'{"unit": "1"}'])
def test_damaged_settings_are_refused(tmp_path, settings):
    page = tmp_path / "a.html"
    html.write(page, blobs(4), {})
    start, rest = page.read_bytes().split(SETTINGS)
    page.write_bytes(start + SETTINGS + settings + rest[rest.index(b"</script>") :])
    with pytest.raises(InputError, match="expected an html page"):
        html.read(page)


def psnr(a, b):
    return 10 * math.log10(255**2 / max(((a.astype(float) - b.astype(float)) ** 2).mean(), 1e-9))


@pytest.mark.slow
@pytest.mark.foreign
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
@pytest.mark.parametrize("factor", [1e-5, 1e5])
def test_a_scene_in_other_units_in_a_browser(tmp_path, factor):
    playwright = pytest.importorskip("playwright.sync_api")
    s, start = blobs(), pose(3)
    far = {**start, "position": [factor * x for x in start["position"]]}
    assert html.unit_of(scaled(s, factor)) != 1
    write(tmp_path / "a.html", scaled(s, factor), {"camera": far, "cameras": [far], "background": BACKGROUND})
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.goto((tmp_path / "a.html").as_uri())
        page.wait_for_function("window.sceneExperts", timeout=60_000)
        page.add_style_tag(content="#bar { display: none }")
        page.wait_for_function("sceneExperts.settled().then(() => true)", timeout=60_000)
        shown = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
        browser.close()
    assert psnr(shown, ours(s, start)) > 28


@pytest.mark.slow
@pytest.mark.foreign
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_page_in_a_browser(tmp_path):
    """The start pose, a pose set from outside, one from the link, a drag and a key: from disk, without a request to anywhere."""
    playwright = pytest.importorskip("playwright.sync_api")
    s, first, second = blobs(), pose(3), pose(4, 3.0)
    write(tmp_path / "a.html", s, {"camera": first, "cameras": [first, second], "background": BACKGROUND, "title": "<b>"})
    write(tmp_path / "b.html", s, {"camera": second, "cameras": [first, second], "background": BACKGROUND, "title": "<b>"})
    with playwright.sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        requests, errors = [], []
        page.on("request", lambda request: requests.append(request.url))
        page.on("pageerror", lambda error: errors.append(str(error)))

        def shot():
            page.evaluate("sceneExperts.settled()")
            return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))

        page.goto((tmp_path / "a.html").as_uri())
        page.wait_for_function("window.sceneExperts", timeout=60_000)
        page.add_style_tag(content="#bar { display: none }")
        start, wanted = shot(), ours(s, first)
        assert wanted.std() > 20 and psnr(start, wanted) > 28
        page.evaluate("pose => sceneExperts.setPose(pose)", second)
        moved = shot()
        assert psnr(moved, ours(s, second)) > 28 and psnr(moved, start) < 20
        found = page.evaluate("sceneExperts.pose()")
        np.testing.assert_allclose(found["rotation"], second["rotation"], atol=1e-6)
        np.testing.assert_allclose(found["position"], second["position"], atol=1e-6)
        numbers = lambda values: ",".join(str(v) for v in np.ravel(values))  # noqa: E731
        page.evaluate(f"location.hash = 'position={numbers(first['position'])}&rotation={numbers(first['rotation'])}&fov={FOV}'")
        page.wait_for_timeout(200)
        assert psnr(shot(), start) > 40
        for fov in ("", "&fov=0", "&fov=200"):  # a link without a usable field of view has that of the scene
            page.evaluate(f"location.hash = 'position={numbers(first['position'])}&rotation={numbers(first['rotation'])}{fov}'")
            page.wait_for_timeout(200)
            assert page.evaluate("sceneExperts.pose().fov") == pytest.approx(FOV) and psnr(shot(), start) > 40
        page.keyboard.press("]")
        assert psnr(shot(), moved) > 40
        other = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        other.goto((tmp_path / "b.html").as_uri())  # one that starts at the second of its poses
        other.wait_for_function("window.sceneExperts", timeout=60_000)
        for key, there in (("]", first), ("[", second)):
            other.keyboard.press(key)
            np.testing.assert_allclose(other.evaluate("sceneExperts.pose()")["position"], there["position"], atol=1e-6)
        other.close()
        page.mouse.move(160, 120)
        page.mouse.down()
        page.mouse.move(220, 140, steps=5)
        page.mouse.up()
        dragged = shot()
        assert psnr(dragged, moved) < 30
        page.keyboard.down("w")
        page.wait_for_timeout(400)
        page.keyboard.up("w")
        flown = shot()
        assert psnr(flown, dragged) < 40
        page.evaluate(TAP)
        assert psnr(shot(), flown) < 40
        assert page.title() == "<b>" and errors == [] and all(url.startswith(("file:", "blob:", "data:")) for url in requests)
        browser.close()


def test_the_script_is_made_of_its_sources():
    """`npm install && npm run build` in tools/viewer makes it."""
    found = hashlib.sha256()
    for name in ("live/keys.js", "live/link.js", "live/panels.js", "live/screen.js", "viewer.js", "build.js", "package.json"):
        found.update((Path("tools/viewer") / name).read_bytes())
    assert gzip.decompress((html.ASSETS / "viewer.min.js.gz").read_bytes()).startswith(f"// {found.hexdigest()}\n".encode())


def test_the_scene_comes_back_out_of_the_page(tmp_path):
    s = scene(200, 2)
    write(tmp_path / "a.html", s, {})
    check("baked-html", read(tmp_path / "a.html"), s)
    text = (tmp_path / "a.html").read_text()
    assert not re.search(r"""(src|href)=["']?(https?:)?//""", text) and "WORLD LABS" in text
    assert text.count("</script>") == 5


@pytest.mark.parametrize("factor", [1e-9, 1e-4, 3e3, 1e9])
def test_a_page_holds_scenes_in_any_unit(tmp_path, factor):
    s = scaled(scene(200, 1, size=1.0), factor)
    assert write(tmp_path / "a.html", s, {}) is None
    found = read(tmp_path / "a.html")
    check("baked-html", scaled(found, 1 / factor), scaled(s, 1 / factor))
    unit = page_settings(s, {})["unit"]
    assert unit != 1 and math.frexp(unit)[0] == 0.5 and f'"unit": {unit}' in (tmp_path / "a.html").read_text()
    assert page_settings(scene(200), {})["unit"] == 1
    s.log_scales[0] += 30
    assert write(tmp_path / "a.html", s, {}) is None  # nobody sees it
    s.log_scales[:5] += 30
    assert "5 of 200" in str(write(tmp_path / "a.html", s, {}))


def test_a_page_without_a_unit_has_that_of_the_capture(tmp_path):
    s = scene(50, 1)
    write(tmp_path / "a.html", s, {})
    text, wanted = (tmp_path / "a.html").read_text(), read(tmp_path / "a.html")
    for entry, same in (("", True), ('"unit": 0,', False), ('"unit": "2",', False), ('"unit": 1e99,', False)):
        (tmp_path / "a.html").write_text(text.replace('"unit": 1.0,', entry))
        if same:
            assert torch.equal(read(tmp_path / "a.html").means, wanted.means)
        else:
            with pytest.raises(InputError, match="unit"):
                read(tmp_path / "a.html")


def test_settings_of_the_page():
    s = blobs()
    entry = {"position": [0, 0, -5.0], "rotation": np.eye(3).tolist(), "fy": 100.0, "height": 200}
    found = page_settings(s, {"camera": entry, "background": [1, 1, 1]})
    assert found["pose"]["fov"] == pytest.approx(90) and found["up"] == [0, -1, 0] and found["background"] == [1, 1, 1]
    assert found["distance"] == pytest.approx(5, rel=0.2) and found["near"] < 0.05 and found["far"] > 100
    away = page_settings(s, {})["pose"]
    assert away["position"][2] < -2 and away["rotation"] == np.eye(3).tolist()
    assert page_settings(s.rows(torch.zeros(0, dtype=torch.int64)), {})["distance"] > 0
    assert json.loads(json.dumps(found)) == found
    for bad in ({"position": [0, 0]}, entry | {"rotation": [[2, 0, 0], [0, 1, 0], [0, 0, 1]]}, entry | {"fov": 180}, {"a": 1}):
        with pytest.raises(InputError, match="position"):
            page_settings(s, {"camera": bad})


def test_a_capture_s_views_in_the_frame_of_the_file():
    world = World(scale=2.0, shift=(1.0, 0.0, -3.0))
    K = torch.tensor([[100.0, 0, 60], [0, 100.0, 40], [0, 0, 1]])
    poses = [torch.eye(4), torch.eye(4)]
    poses[1][:3, 3] = torch.tensor([0.0, 0.0, 7.0])  # the camera's centre at z = -7 of the trained world
    views = tuple(View(f"{i}.jpg", Camera(pose, K, 120, 80, id=i), Path("x")) for i, pose in enumerate(poses))
    capture = SimpleNamespace(name="yard", views=views, test=(0,), train=(1,), points=None, extent=1.0, background=(1.0, 1.0, 1.0))
    note = view_note(capture, world) | {"antialias": True}  # type: ignore[arg-type]
    assert note["camera"] == note["cameras"][1] and len(note["cameras"]) == 2 and note["background"] == [1.0, 1.0, 1.0]
    np.testing.assert_allclose(note["camera"]["position"], [-1.0, 0.0, -3.5 + 3.0], atol=1e-6)
    found = page_settings(blobs(), note)
    assert found["flight"] == page_settings(blobs(), {})["flight"] == []  # one photograph
    both = SimpleNamespace(**{**vars(capture), "train": (0, 1)})
    assert len(page_settings(blobs(), view_note(both, world))["flight"]) == 48  # type: ignore[arg-type]
    assert found["reach"] > 0 and page_settings(blobs(), {})["reach"] is None
    assert found["origin"] == [0.0, 0.0, 0.0] and page_settings(blobs(), note | {"origin": [1e6, 2.0, 3.0]})["origin"] == [1e6, 2.0, 3.0]
    assert found["antialias"] and found["fov"] == pytest.approx(math.degrees(2 * math.atan(0.4)))


def test_damaged_pages(tmp_path):
    path = tmp_path / "a.html"
    for text in (
        "<html>",
        '<script type="text/plain" id="scene">%%%</script>',
        '<script type="text/plain" id="scene">AAAA</script>',
        '<script type="text/plain" id="scene">AAAA',
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=naming(path)):
            read(path)


def test_what_is_vendored_has_its_licences():
    text = (html.ASSETS / "LICENCES.txt").read_text()
    assert (
        all(name in text for name in ("@sparkjsdev/spark 2.2.0", "three 0.187.0", "fflate 0.8.2"))
        and text.count("Permission is hereby") == 3
    )


def test_the_hint_is_in_the_words_of_the_pointer():
    text = (html.ASSETS / "page.html").read_text()
    touch, mouse = (re.search(rf'<dl class="{kind}">(.+?)</dl>', text, re.DOTALL) for kind in ("touch", "mouse"))
    assert touch and mouse and "finger" in touch[1] and "wheel" not in touch[1] and "right drag" in mouse[1]
    coarse, _, fine = text.partition("(pointer: coarse)")[2].partition("(pointer: fine)")
    assert ".mouse { display: none" in coarse and ".touch { display: none" in fine.partition("</style>")[0]


@pytest.mark.slow
@pytest.mark.foreign
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_hints_on_touch_screens_and_none_without_webgl(tmp_path):
    playwright = pytest.importorskip("playwright.sync_api")
    write(tmp_path / "a.html", blobs(20), {"camera": pose()})
    with playwright.sync_playwright() as p:
        for flags, touch, shown in (
            (FLAGS, False, ".mouse"),
            (FLAGS, True, ".touch"),
            (["--no-sandbox", "--disable-gpu", WITHOUT], True, ""),
        ):
            browser = p.chromium.launch(executable_path=CHROMIUM, args=flags)
            page = browser.new_context(viewport={"width": WIDTH, "height": HEIGHT}, has_touch=touch, is_mobile=touch).new_page()
            page.goto((tmp_path / "a.html").as_uri())
            page.wait_for_function("window.sceneExperts || /WebGL/.test(document.getElementById('note').textContent)", timeout=60_000)
            if shown:
                page.click("#ask")
            assert [kind for kind in (".mouse", ".touch") if page.locator(f"#help {kind}").is_visible()] == ([shown] if shown else [])
            assert page.locator("#home").is_visible() == bool(shown)
            browser.close()
