"""Measure what a hostile client of the viewer costs a training: the time of its iterations, and memory (docs/security.md).

    python benchmarks/hostile_viewer.py [--capture demo/buddha] [--recipe moe-gs] [--spell 100] [--most 20]

Periods of a training with and without the client alternate. The client is a process of its own that knows the token, which is more than
a stranger knows. As fast as it can, it connects, sends malformed messages until it is disconnected, and asks for pages with a foreign
Origin, a foreign Host and a wrong token. There are at least four periods with it, and as many
as it takes to send 10,000 messages and to connect 200 times. Densification is off,
so the memory of the training does not grow by itself. Exit code 1 if the iterations take more than 1.2 times as long, if memory grows by
more than 100 MB, or if a foreign request is served.
"""

from __future__ import annotations

import argparse
import json
import random
import signal
import statistics
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

MESSAGES, CONNECTIONS = 10_000, 200
LEAST = 4  # periods with the client
CLIENT = "import sys; sys.path.insert(0, sys.argv[1]); import hostile_viewer; hostile_viewer.attack(sys.argv[2])"
FOREIGN = (
    {"Host": "evil.example"},
    {"Host": "localhost.evil.example", "Origin": "http://localhost.evil.example"},
    {"Origin": "http://evil.example"},
    {"Origin": "null"},
)


def make_message(rng: random.Random, uuids: list[str]) -> bytes:
    """Return a message that no page would send."""
    import msgspec

    value = rng.choice([float("nan"), float("inf"), -1, 10**18, "x", None, [], {}, [1e308] * 4, b"\0" * 100])
    kind = rng.randrange(5)
    if kind == 0:
        return rng.randbytes(rng.randrange(60))
    if kind == 1:
        return b"\x91" * rng.randrange(1, 3000)
    if kind == 2:
        return msgspec.msgpack.encode({"type": "ViewerCameraMessage", "wxyz": value, "position": value, "fov": value})
    if kind == 3:
        return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": rng.choice([*uuids, "x"]), "updates": {"value": value}})
    return msgspec.msgpack.encode({"type": rng.choice(["SceneNodeClickMessage", "FileTransferPart", "", 7]), "x": value})


def ask(port: int, path: str, headers: dict[str, str]) -> int:
    """Return the status of a page's answer; 0 if the connection was closed."""
    import http.client

    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10)
    try:
        connection.request("GET", path, headers=headers)
        return connection.getresponse().status
    except (OSError, http.client.HTTPException):
        return 0
    finally:
        connection.close()


def attack(url: str) -> None:
    """Attack the viewer at `url`, which has the token, until SIGTERM. Print the counts."""
    import viser
    from websockets.exceptions import WebSocketException
    from websockets.sync.client import connect

    count: Counter[str] = Counter()
    ended: list[int] = []
    signal.signal(signal.SIGTERM, lambda *_: ended.append(1))
    rng, port = random.Random(time.time_ns()), int(url.split(":")[2].split("/")[0])
    end = time.monotonic() + 120
    while not ended and time.monotonic() < end:
        try:
            with connect(url.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], open_timeout=10) as socket:  # type: ignore[list-item]
                count["connections"] += 1
                for _ in range(120):
                    socket.send(make_message(rng, []))
                    count["messages"] += 1
        except (OSError, WebSocketException):
            count["refused or closed"] += 1
        for headers in FOREIGN:
            status = ask(port, "/?" + url.partition("?")[2], headers)
            count["foreign requests"] += 1
            count["foreign requests served"] += status == 200
        count["foreign requests served"] += ask(port, "/?token=wrong", {}) == 200
    print(json.dumps(count), flush=True)


def read_memory() -> int:
    """Return the resident memory of this process in bytes."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(1024 * int(line.split()[1]) for line in lines if line.startswith("VmRSS:"))


def measure(capture_path: Path, recipe: str, spell: int, most: int) -> tuple[float, float, int, Counter[str]]:
    """Return the seconds of an iteration without and with the client, the growth of memory in bytes, and the client's counts."""
    from scene_experts.data import capture as captures
    from scene_experts.data.settings import Data
    from scene_experts.render import choose
    from scene_experts.training import loop
    from scene_experts.training.config import RunConfig
    from scene_experts.training.options import TrainOptions
    from scene_experts.training.recipes import RECIPES
    from scene_experts.view.live import Live

    capture = captures.load(Data(capture_path, resolution="factor:4"))
    cfg = RECIPES[recipe][1]
    cfg = replace(cfg, growth=replace(cfg.growth, enabled=False))
    rasterize, said = choose("auto", "cpu"), []
    live, times = Live(capture, rasterize, lambda: False, port=0, ready=said.append), []

    def watch(training) -> None:
        live(training)
        times.append(time.monotonic())

    events = loop.train(
        cfg,
        loop.Job(RunConfig(cfg, Data(capture_path)), watch=watch, options=TrainOptions(log_every=1, preview_every=0)),
        capture,
        rasterize,
    )

    def measure_spell(iterations: int) -> list[float]:
        times.clear()
        while len(times) <= iterations:
            next(events)
        return [b - a for a, b in pairwise(times)]

    took: dict[bool, list[float]] = {True: [], False: []}
    count: Counter[str] = Counter()
    try:
        measure_spell(spell)
        before = read_memory()
        for number in range(most):
            took[False] += measure_spell(spell)
            command = [sys.executable, "-c", CLIENT, str(Path(__file__).parent), said[0]]
            process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            opened = live.viewer.gate.open  # type: ignore[union-attr]
            while live.viewer.gate.open == opened and process.poll() is None:  # type: ignore[union-attr]
                measure_spell(1)
            took[True] += measure_spell(spell)
            process.terminate()
            out, _ = process.communicate(timeout=60)
            count += Counter(json.loads(out.splitlines()[-1]))
            if number + 1 >= LEAST and count["messages"] >= MESSAGES and count["connections"] >= CONNECTIONS:
                break
        measure_spell(20)
        grown = read_memory() - before
    finally:
        live.close()
        capture.images.close()
    return statistics.mean(took[False]), statistics.mean(took[True]), grown, count


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--capture", type=Path, default=Path(__file__).resolve().parents[1] / "demo" / "buddha")
    parser.add_argument("--recipe", default="moe-gs")
    parser.add_argument("--spell", type=int, default=100, help="iterations of one period (default: 100)")
    parser.add_argument("--most", type=int, default=20, help="largest number of periods with the client (default: 20)")
    args = parser.parse_args()
    alone, attacked, grown, count = measure(args.capture, args.recipe, args.spell, args.most)
    count.setdefault("foreign requests served", 0)
    print(", ".join(f"{name}: {number:,}" for name, number in sorted(count.items())))
    print(f"iteration: {alone * 1e3:.1f} ms alone, {attacked * 1e3:.1f} ms with the client: {attacked / alone:.2f}x")
    print(f"memory: {grown / 1e6:+.0f} MB")
    return int(attacked > 1.2 * alone or grown > 100e6 or count["foreign requests served"] > 0)


if __name__ == "__main__":
    sys.exit(main())
