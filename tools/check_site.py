"""Checks the built documentation site (`make docs`): links, what it loads, and how far things are from the first page.

    python tools/check_site.py build/site

It needs no network. A link to another site is not followed.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit

LOADS = {"script": "src", "img": "src", "iframe": "src", "source": "src", "video": "src", "link": "href"}  # what a page fetches
CLICKS = 2
DEEP = "repository/results/"  # generated tables may be further away


class Page(HTMLParser):
    """A page: the anchors that it has, the links on it, and what it loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.ids: set[str] = {""}
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = dict(attrs)
        self.ids |= {value for name in ("id", "name") if (value := found.get(name))}
        if tag == "a" and found.get("href"):
            self.links.append(found["href"] or "")
        where = found.get(LOADS.get(tag, "")) if tag in LOADS else None
        if where and not (tag == "link" and found.get("rel") in ("canonical", "next", "prev", "edit")):
            self.loads.append(where)


def read_site(site: Path) -> dict[str, Page]:
    """Return the pages of a site by their path in it."""
    return {path.relative_to(site).as_posix(): Page(path.read_text()) for path in sorted(site.rglob("*.html"))}


def resolve(here: str, link: str) -> tuple[str, str] | None:
    """Return the path within the site and the anchor that a link on the page `here` leads to; None for another site."""
    parts = urlsplit(link)
    if parts.scheme or parts.netloc:
        return None
    path: list[str] = here.split("/")[:-1]
    for step in unquote(parts.path).split("/") if parts.path else here.split("/")[-1:]:
        if step == "..":
            path = path[:-1]
        elif step not in ("", "."):
            path = [*path, step]
    return "/".join(path), unquote(parts.fragment)


def find_dead(site: Path, pages: dict[str, Page]) -> Iterator[str]:
    """Yield a line for each link without a target, and for each thing that is loaded from another site."""
    for here, page in pages.items():
        if here == "404.html":  # its links are those of the site's address
            continue
        for link in dict.fromkeys(page.links + page.loads):
            if link.startswith(("data:", "mailto:", "javascript:")):
                continue
            found = resolve(here, link)
            if found is None:
                if link in page.loads:
                    yield f"{here} loads {link}"
                continue
            path, anchor = found
            if path not in pages:
                if not (site / path).is_file():
                    yield f"{here}: {link} leads nowhere"
            elif anchor not in pages[path].ids and not anchor.startswith("__"):
                yield f"{here}: {link} has no such anchor"


def count_clicks(pages: dict[str, Page], first: str = "index.html", most: int = CLICKS) -> set[tuple[str, str]]:
    """Return the places (path, anchor) within `most` clicks from the page `first`."""
    reached, new = {(first, "")}, {(first, "")}
    for _ in range(most):
        new = {found for path, _ in new if path in pages for link in pages[path].links if (found := resolve(path, link))} - reached
        reached |= new
    return reached


def main() -> int:
    site = Path(sys.argv[1])
    pages = read_site(site)
    wrong = list(find_dead(site, pages))
    reached = {path for path, _ in count_clicks(pages)}
    far = [path for path in pages if path not in reached and path != "404.html" and not path.startswith(DEEP)]
    wrong += [f"{path} is more than {CLICKS} clicks from the first page" for path in far]
    index = site / "search" / "search_index.js"
    if not index.is_file() or not re.match(r"var __index ?=", index.read_text()[:40]):
        wrong.append("the search index for use from disk is missing")
    print("\n".join(wrong) or f"{len(pages)} pages: no dead link, nothing loaded from elsewhere, every page within {CLICKS} clicks")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
