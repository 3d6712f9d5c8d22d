"""How fast a compact file of a run is written and read, on one core.

    OMP_NUM_THREADS=1 python benchmarks/codec.py RUN

Writes the run's compact file, and prints the CPU seconds to fit its models, to code it with them and
to decode it, and anchors per second: the least of several turns. Peer: zlib, level 9, of the file
that holds the same scene as it is (--format anchors). Where there are Node, and Chromium with playwright, they read
the file by integrations/javascript too, compiled and plain: the first time in a new process or
tab, and the least of several. Chromium's are seconds of the clock.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import shutil
import subprocess
import tempfile
import threading
import time
import zlib
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import scene_experts as se
from scene_experts.core.reading import budget
from scene_experts.core.reading.source import opening
from scene_experts.files.anchors import compact
from scene_experts.files.anchors.data import AnchorData
from scene_experts.files.codec.fit import fit_models

TURNS = 7
READER = Path(__file__).resolve().parents[1] / "integrations" / "javascript"
PROGRAM = """
const { plain } = await import(`${folder}/coder.mjs`), { readCompact } = await import(`${folder}/compact.mjs`), found = [];
for (let i = 0; i < TURNS; ++i) {
  const began = now();
  await readCompact(bytes, how === "plain" ? plain : undefined);
  found.push(now() - began);
}
console.log(JSON.stringify([found[0], Math.min(...found)]));
""".replace("TURNS", str(TURNS))
NODE = """
import { readFileSync } from "node:fs";
const [folder, path, how] = process.argv.slice(1), bytes = new Uint8Array(readFileSync(path));
const now = () => { const { user, system } = process.cpuUsage(); return (user + system) / 1e6; };
"""
PAGE = """<script type=module>
const folder = "/javascript", how = location.hash.slice(1), now = () => performance.now() / 1e3;
const bytes = new Uint8Array(await (await fetch("/scene.compact")).arrayBuffer());
"""


def least(work: Callable[[], object]) -> float:
    """Return the least CPU seconds of some turns."""
    seconds = []
    for _ in range(TURNS):
        began = time.process_time()
        work()
        seconds.append(time.process_time() - began)
    return min(seconds)


def written(run: se.Run, folder: Path) -> tuple[AnchorData, bytes, Path]:
    """The scene as it is given to the codec, with its precision, the bytes of its compact file, and
    the exact file."""
    given: list[AnchorData] = []
    encode = compact.encode

    def kept(data: AnchorData) -> Any:
        given.append(data)
        return encode(data)

    compact.encode = kept
    try:
        file = run.export("compact", folder / "scene.compact")
    finally:
        compact.encode = encode
    exact = run.export("anchors", folder / "exact")
    return given[-1], file.read_bytes(), exact


def in_node(file: Path, how: str) -> list[float]:
    """CPU seconds of the first reading and the least."""
    command = ["node", "--input-type=module", "-e", NODE + PROGRAM, READER.as_uri(), str(file), how]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


class Quiet(SimpleHTTPRequestHandler):
    """A server of files that says nothing."""

    def log_message(self, *_: object) -> None:
        pass


def in_chromium(file: Path, how: str) -> list[float]:
    """Seconds of the first reading and the least."""
    from playwright.sync_api import sync_playwright

    with tempfile.TemporaryDirectory() as folder:
        shutil.copytree(READER, Path(folder) / "javascript")
        shutil.copy(file, Path(folder) / "scene.compact")
        (Path(folder) / "index.html").write_text(PAGE + PROGRAM + "</script>")
        server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder))
        threading.Thread(target=server.serve_forever, daemon=True).start()
        try:
            with sync_playwright() as p, p.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"]) as browser:
                tab = browser.new_page()
                with tab.expect_console_message(lambda message: message.text.startswith("["), timeout=300_000) as said:
                    tab.goto(f"http://127.0.0.1:{server.server_port}/#{how}")
                return json.loads(said.value.text)
        finally:
            server.shutdown()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        data, file, exact = written(se.open_run(args.run), Path(folder))
        plain = b"".join(part.read_bytes() for part in sorted(exact.rglob("*")) if part.is_file()) if exact.is_dir() else exact.read_bytes()
        n, found = len(data.columns["xyz"]), compact.arrange(data)
        models = fit_models(found.groups, found.way, found.whole.values)
        rows = {"fit": least(lambda: fit_models(found.groups, found.way, found.whole.values))}
        fitted = compact.fit_models
        compact.fit_models = lambda *_: models
        rows["code"] = least(lambda: compact.encode(data))
        compact.fit_models = fitted
        seconds = []
        for _ in range(TURNS):  # each reads with a budget of its own
            with opening(Path(folder) / "scene.compact", budget.COMPACT) as source:
                began = time.process_time()
                compact.decode(file, source)
                seconds.append(time.process_time() - began)
        rows["decode"] = min(seconds)
        for name, read in (("node", in_node), ("chromium", in_chromium)):
            there = shutil.which(name) and (name == "node" or importlib.util.find_spec("playwright"))
            for how in ("compiled", "plain") if there else ():
                rows[f"{name}, {how}, first"], rows[f"{name}, {how}"] = read(Path(folder) / "scene.compact", how)
        packed = zlib.compress(plain, 9)
        rows["zlib, pack"], rows["zlib, unpack"] = least(lambda: zlib.compress(plain, 9)), least(lambda: zlib.decompress(packed))
    print(f"{n:,} anchors; {len(file):,} bytes, exact {len(plain):,}, by zlib {len(packed):,}")
    for name, value in rows.items():
        print(f"{name}: {value:.3f} {'s' if name.startswith('chromium') else 'CPU s'}, {n / value / 1e6:.2f} M anchors/s")


if __name__ == "__main__":
    main()
