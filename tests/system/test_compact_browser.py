"""The reader of compact files in headless Chromium: compiled and plain find the file's numbers, also where a page forbids WebAssembly."""

import json
import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

from scene_experts.files.anchors import compact
from scene_experts.files.codec import container
from support.compact import make_scene
from support.live_page import CHROMIUM
from support.places import ROOT

playwright = pytest.importorskip("playwright.sync_api")
pytestmark = [pytest.mark.slow, pytest.mark.foreign, pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")]
PAGE = b"<script type=module src=read.mjs></script>"
PROGRAM = """
import { plain } from "./coder.mjs";
import { loadCoder } from "./compiled.mjs";
import { readCompact } from "./compact.mjs";
const bytes = new Uint8Array(await (await fetch("a.compact")).arrayBuffer());
const found = [await readCompact(bytes), await readCompact(bytes, plain)].map((scene) => scene.checksum);
console.log(JSON.stringify([(await loadCoder()) === plain, ...found]));
"""


class Handler(SimpleHTTPRequestHandler):
    """Serves a folder. The page `strict` forbids WebAssembly."""

    def do_GET(self):
        if not self.path.endswith((".mjs", ".compact")):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            if "strict" in self.path:
                self.send_header("Content-Security-Policy", "script-src 'self'")
            self.end_headers()
            self.wfile.write(PAGE)
            return
        super().do_GET()

    def log_message(self, *_):
        pass


@pytest.mark.parametrize(("page", "wanted_plain"), [("open", False), ("strict", True)])
def test_chromium_reads_the_same_numbers(tmp_path, page, wanted_plain):
    for path in (ROOT / "integrations" / "javascript").iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / "read.mjs").write_text(PROGRAM)
    compact.write(tmp_path / "a.compact", make_scene(300), {})
    header, _ = container.part((tmp_path / "a.compact").read_bytes())
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Handler, directory=str(tmp_path)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with playwright.sync_playwright() as p:
            browser = p.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            tab = browser.new_page()
            with tab.expect_console_message() as said:
                tab.goto(f"http://127.0.0.1:{server.server_port}/{page}")
            is_plain, *found = json.loads(said.value.text)
            browser.close()
    finally:
        server.shutdown()
    assert is_plain == wanted_plain and found == [header["integers"]] * 2
