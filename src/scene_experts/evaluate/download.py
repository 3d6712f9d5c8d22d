"""Downloads the published LPIPS weights, on request only: resumable, checked, and put in place whole or not at all."""

from __future__ import annotations

import http.client
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path

from scene_experts.errors import RunError
from scene_experts.evaluate import weights

TORCHVISION = "https://download.pytorch.org/models"
LPIPS = "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/082bb24f84c091ea94de2867d34c4544f68e0963/lpips/weights/v0.1"
Progress = Callable[[int, int], None]  # bytes so far, bytes in all (0: unknown)


def lpips(net: str, *, backbones: str = TORCHVISION, linears: str = LPIPS, progress: Progress | None = None) -> str:
    """Fetch backbone (vgg 528 MB, alex 233 MB) and linear layers of `net`, keep the 59 or 10 MB needed; a line on where they lie.

    Files whose content is right already are not fetched again. Raises RunError when the network or the content fails.
    """
    folder = weights.cache_dir()
    for base, (name, digest) in ((backbones, weights.BACKBONE[net]), (linears, weights.LINEAR[net])):
        fetch(f"{base}/{name}", folder / name, digest, progress)
    _, what = weights.load(net)
    if weights.cache_file(net).is_file():  # the tensors we need are kept there
        (folder / weights.BACKBONE[net][0]).unlink(missing_ok=True)
    return what


def fetch(url: str, path: Path, digest: str, progress: Progress | None = None) -> None:
    """Download `url` to `path`, whose SHA-256 must become `digest`.

    What an interrupted download left in `<name>.part` is continued where the server allows it. Content with another checksum is removed.
    """
    if path.is_file() and weights.sha256(path) == digest:
        return
    part = path.with_name(path.name + ".part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if not (part.is_file() and weights.sha256(part) == digest):
            _continue(url, part, progress)
        found = weights.sha256(part)
        if found != digest:
            part.unlink()
            raise RunError(f"expected SHA-256 {digest[:12]}... from {url}, found {found[:12]}...; try again later, or give --lpips-weights")
        part.replace(path)
    except urllib.error.HTTPError as error:
        raise RunError(f"cannot download {url}: the server answered {error.code}; try again later, or give --lpips-weights") from error
    except (OSError, http.client.HTTPException) as error:
        reason = getattr(error, "reason", None) or error
        raise RunError(f"cannot download {url}: {reason}; run the command again to continue it, or give --lpips-weights") from error


def _continue(url: str, part: Path, progress: Progress | None) -> None:
    """Append what is missing of `url` to `part`, or start over where the server sends the whole file."""
    have = part.stat().st_size if part.is_file() else 0
    headers = {"User-Agent": "scene-experts", **({"Range": f"bytes={have}-"} if have else {})}
    try:
        answer = urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=60)
    except urllib.error.HTTPError as error:
        if error.code != 416 or not have:  # 416: there is nothing after what we have, so it is not a beginning of the file
            raise
        part.unlink()
        return _continue(url, part, progress)
    with answer:
        resumed = answer.status == 206
        have = have if resumed else 0
        total = have + int(answer.headers.get("Content-Length") or 0)
        with part.open("ab" if resumed else "wb") as stream:
            while block := answer.read(1 << 20):
                stream.write(block)
                have += len(block)
                if progress:
                    progress(have, total)
    if total and have < total:
        raise OSError(f"the connection ended after {have} of {total} bytes")
