"""A live page in headless Chromium: with WebGPU in software, or with WebGL 2 alone; its pictures, and its decoded Gaussians."""

from __future__ import annotations

import base64
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
GPU = [
    "--no-sandbox",
    "--disable-gpu-watchdog",
    "--enable-unsafe-webgpu",
    "--enable-features=Vulkan,WebGPU",
    "--use-vulkan=swiftshader",
    "--use-webgpu-adapter=swiftshader",
    "--disable-vulkan-surface",
    "--ignore-gpu-blocklist",
]
GL = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
# A canvas takes the software device away: the page gets a texture in its place. The numbers of passes and dispatches are counted.
_STAND_IN = """
(() => {
  const real = HTMLCanvasElement.prototype.getContext;
  HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
    if (kind !== "webgpu") return real.call(this, kind, ...more);
    let texture = null, how = null;
    return { configure: (given) => { how = given; }, getCurrentTexture: () => {
      texture ??= how.device.createTexture({ size: [this.width, this.height], format: how.format, usage: 0x10 });
      return texture;
    } };
  };
  window.counted = { dispatches: 0, draws: 0 };
  const count = (type, name, into) => {
    const real = type.prototype[name];
    type.prototype[name] = function (...given) { window.counted[into] += 1; return real.apply(this, given); };
  };
  if (!globalThis.GPUComputePassEncoder) return;
  for (const name of ["dispatchWorkgroups", "dispatchWorkgroupsIndirect"]) count(GPUComputePassEncoder, name, "dispatches");
  for (const name of ["draw", "drawIndirect"]) count(GPURenderPassEncoder, name, "draws");
})();
"""
_BYTES = """(array) => {
  const bytes = new Uint8Array(array.buffer ?? array, array.byteOffset ?? 0, array.byteLength);
  let text = "";
  for (let i = 0; i < bytes.length; i += 32768) text += String.fromCharCode(...bytes.subarray(i, i + 32768));
  return btoa(text);
}"""
TAP = """(() => {
  const send = (type) => document.body.dispatchEvent(new KeyboardEvent(type, { code: "KeyW", bubbles: true }));
  send("keydown");
  for (const start = performance.now(); performance.now() - start < 300; );
  send("keyup");
})()"""  # a key that no frame sees held


class LivePage:
    """A tab with a live page. change: a script that runs before the page's. errors: what its console says; requests: what it asks for."""

    def __init__(self, tab: Any, change: str = "") -> None:
        self.tab, self.errors, self.requests = tab, [], []
        if change:
            tab.add_init_script(change)
        tab.on("pageerror", lambda error: self.errors.append(str(error)))
        tab.on("console", lambda message: self.errors.append(message.text) if message.type == "error" else None)
        tab.on("request", lambda request: self.requests.append(request.url))

    def open(self, path: Path, seconds: float = 300) -> LivePage:
        """Open a page and wait for its first picture, or for a sentence in its place."""
        self.tab.set_default_timeout(1000 * seconds)
        self.tab.goto(path.as_uri())
        self.tab.wait_for_function(
            "window.sceneExperts?.page.renderer || /^(The scene|This page)/.test(document.getElementById('note').textContent)"
        )
        return self

    @property
    def said(self) -> str:
        """The sentence on the page."""
        return self.tab.evaluate("document.getElementById('note').hidden ? '' : document.getElementById('note').textContent")

    @property
    def renderer(self) -> str:
        return self.tab.evaluate("sceneExperts.page.renderer.name")

    def settle(self) -> None:
        self.tab.evaluate("sceneExperts.settled()")

    def picture(self, background: Any) -> np.ndarray:
        """The last picture before it is copied to the canvas, over a background: [H, W, 3] float."""
        pixels = "sceneExperts.page.renderer.renderer.pixels()"
        got = self.tab.evaluate(f"(async () => {{ const p = await {pixels}; return {{ ...p, data: ({_BYTES})(p.data) }}; }})()")
        raw, width, height = base64.b64decode(got["data"]), got["width"], got["height"]
        if "row" in got:
            rows = np.frombuffer(raw, "<f2").reshape(height, got["row"] // 2)[:, : 4 * width].reshape(height, width, 4).astype(np.float32)
        else:
            rows = np.frombuffer(raw, "<f4").reshape(height, width, 4)[::-1]
        return np.clip(rows[..., :3] + (1 - rows[..., 3:]) * np.asarray(background, np.float32), 0, 1)

    def decoded(self) -> np.ndarray:
        """What WebGPU decoded, with 32 bits: [Gaussians, 16] mean 3, opacity, size 3, -, rotation 4 (w x y z), colour 3, -."""
        text = self.tab.evaluate(
            f"(async () => {{ const r = sceneExperts.page.renderer.renderer; return ({_BYTES})(await r.gpu.read(r.decoded)); }})()"
        )
        found = np.frombuffer(base64.b64decode(text), "<f4")
        return found[: len(found) // 16 * 16].reshape(-1, 16)


@contextmanager
def browsers(flags: list[str], width: int, height: int) -> Iterator[Any]:
    """A function that makes a `LivePage`."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as p:
        browser = p.chromium.launch(executable_path=CHROMIUM, args=flags)

        def make(change: str = "") -> LivePage:
            tab = browser.new_page(viewport={"width": width, "height": height})
            if flags is GPU:
                tab.add_init_script(_STAND_IN)
            return LivePage(tab, change)

        yield make
        browser.close()
