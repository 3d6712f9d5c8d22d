"""Opens pages in headless Chromium: reports violations of axe-core and errors in the browser's console.

    pip install playwright axe-playwright-python
    python tools/check_pages.py build/site runs/demo/report.html runs/demo/scene.html

A folder is a site: it is served on a local port, and all its pages are opened. Other pages are opened from disk. Each is opened in light
and in dark colours, on a wide and on a narrow screen.
The exit code is 1 if something was found.
"""

from __future__ import annotations

import shutil
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from itertools import product
from pathlib import Path
from threading import Thread
from typing import Any
from urllib.parse import quote

FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
SCREENS = ((1280, 900), (390, 844))
COLOURS = ("light", "dark")
SETTLE = 500  # milliseconds for a page to draw


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """Serve a folder on a local port, and yield its address."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, format: str, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(folder)))
    Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_port}"
    finally:
        server.shutdown()


def find_addresses(path: Path, stack: ExitStack) -> list[str]:
    """Return the addresses of the page or the pages that a path stands for. The stack ends the server of a folder."""
    if not path.is_dir():
        return [path.resolve().as_uri()]
    root = stack.enter_context(served(path))
    return [f"{root}/{quote(page.relative_to(path).as_posix())}" for page in sorted(path.rglob("*.html"))]


def listen(tab: Any) -> list[str]:
    """Return the list that the errors of a tab are added to."""
    errors: list[str] = []
    tab.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
    tab.on("pageerror", lambda error: errors.append(str(error)))
    return errors


def check_page(browser: Any, axe: Any, page: str) -> Iterator[str]:
    """Yield a line for each thing that is wrong with a page."""
    for (width, height), colours in product(SCREENS, COLOURS):
        context = browser.new_context(viewport={"width": width, "height": height}, color_scheme=colours)
        tab = context.new_page()
        errors = listen(tab)
        tab.goto(page)
        tab.wait_for_timeout(SETTLE)
        where = f"{page} ({width} px, {colours})"
        for violation in axe.run(tab).response["violations"]:
            places = ", ".join(" ".join(map(str, node["target"])) for node in violation["nodes"][:3])
            yield f"{where}: {violation['id']}, {len(violation['nodes'])} places: {violation['help']} ({places})"
        yield from (f"{where}: console: {error}" for error in errors)
        context.close()


def main(arguments: list[str]) -> int:
    from axe_playwright_python.sync_playwright import Axe
    from playwright.sync_api import sync_playwright

    browser_path = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    count = 0
    with ExitStack() as stack, sync_playwright() as playwright:
        pages = [page for argument in arguments for page in find_addresses(Path(argument), stack)]
        browser = playwright.chromium.launch(executable_path=browser_path, args=FLAGS)
        for page in pages:
            for line in check_page(browser, Axe(), page):
                count += 1
                print(line, flush=True)
        browser.close()
    print(f"{len(pages)} pages, {len(SCREENS) * len(COLOURS)} ways each: {count} findings")
    return int(count > 0 or not pages)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
