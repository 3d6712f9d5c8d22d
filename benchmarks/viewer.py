"""Measure the viewer: frames per second that a moving client receives from a trained run, and the cost of a client to a training.

    python benchmarks/viewer.py RUN [--data CAPTURE] [--width 640 --height 360] [--seconds 8] [--spells 6]

Serving: a client in its own process speaks the protocol of the page, sends sixty camera messages per second along the captured cameras,
and counts the images that arrive. First the images keep their full size; then their size adapts, and the client counts again.
Training: the recipe of the run trains again on its capture. From iteration 600 on, periods with and without a moving client alternate,
and the script compares their iteration times, which include drawing for the client.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import subprocess
import sys
import threading
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import torch

from scene_experts.data import capture as captures
from scene_experts.data.capture import Capture
from scene_experts.geometry.rotation import matrix_to_quat
from scene_experts.render import Rasterizer, choose
from scene_experts.training import loop as train
from scene_experts.training import run_folder
from scene_experts.training.options import TrainOptions
from scene_experts.training.run_folder import OpenRun
from scene_experts.view import paths, server
from scene_experts.view.live import Live
from scene_experts.view.server import Viewer

Pose = tuple[list[float], list[float], list[float], float]  # rotation (w, x, y, z), position, a point ahead, vertical FOV in radians
FIRST, SPELL = 600, 60  # iterations before the first period, and iterations per period


def run_client(url: str, seconds: float, width: int, height: int, along: list[Pose]) -> None:
    """Move for `seconds`; print the images per second after the first second, and their mean size in bytes."""
    import msgspec
    import viser
    import zstandard
    from viser._messages import ViewerCameraMessage
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    sizes: list[int] = []
    began = time.monotonic()

    def listen(socket: object) -> None:
        unzip = zstandard.ZstdDecompressor()
        while True:
            try:
                raw = socket.recv()  # type: ignore[attr-defined]
            except (ConnectionClosed, OSError):
                return
            inner, packed = int.from_bytes(raw[:8], "little"), int.from_bytes(raw[8:16], "little")
            for message in msgspec.msgpack.decode(unzip.decompress(raw[16 : 16 + packed], inner))["messages"]:
                if message["type"] == "BackgroundImageMessage" and time.monotonic() - began > 1:
                    sizes.append(len(raw))

    with connect(url.replace("http", "ws"), subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as socket:  # type: ignore[list-item]
        thread = threading.Thread(target=listen, args=(socket,), daemon=True)
        thread.start()
        i = 0
        while time.monotonic() - began < seconds + 1:
            quat, place, ahead, fov = along[i % len(along)]
            i += 1
            message = ViewerCameraMessage(
                tuple(quat), tuple(place), fov, 0.01, 1000.0, height, width, tuple(ahead), (0.0, -1.0, 0.0)  # type: ignore[arg-type]
            )  # fmt: skip
            socket.send(msgspec.msgpack.encode(message.as_serializable_dict()))
            time.sleep(1 / 60)
    thread.join(2)
    print(len(sizes) / seconds, statistics.mean(sizes) if sizes else 0.0, flush=True)


def list_poses(capture: Capture, count: int = 240) -> list[Pose]:
    """Poses along the captured cameras and back, as a closed loop."""
    cameras = paths.make_path("views", capture, count).cameras
    out = []
    for camera in (*cameras, *reversed(cameras)):
        rotation = camera.world_to_cam[:3, :3].T.double()
        place = camera.position.double()
        fov = 2 * math.atan(camera.height / (2 * camera.fy))
        out.append((matrix_to_quat(rotation).tolist(), place.tolist(), (place + rotation[:, 2]).tolist(), fov))
    return out


def start_client(url: str, seconds: float, size: tuple[int, int], along: list[Pose]) -> subprocess.Popen[str]:
    """Start `run_client` in its own process."""
    code = "import sys, json; sys.path.insert(0, sys.argv[1]); import viewer; viewer.run_client(sys.argv[2], *json.load(sys.stdin))"
    command = [sys.executable, "-c", code, str(Path(__file__).parent), url]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdin is not None
    process.stdin.write(json.dumps([seconds, *size, along]))
    process.stdin.close()
    return process


def measure_serving(run: OpenRun, capture: Capture, rasterize: Rasterizer, seconds: float, size: tuple[int, int]) -> None:
    viewer = Viewer(capture, lambda: (run.scene, run.step), rasterize, port=0, draws=run.scene.frozen(run.step))
    along, smallest = list_poses(capture), server.SMALLEST
    print(f"{len(run.scene.table):,} rows, {torch.get_num_threads()} thread(s), {size[0]}x{size[1]}")
    try:
        for label, least in (("full size", 1.0), ("adaptive size", smallest)):
            server.SMALLEST = least
            process = start_client(viewer.url, seconds, size, along)
            viewer.serve(lambda: process.poll() is not None)  # noqa: B023
            assert process.stdout is not None
            rate, weight = (float(word) for word in process.stdout.read().split())
            print(f"{label}: {rate:.1f} images/s, {weight / 1e3:.0f} kB each")
    finally:
        server.SMALLEST = smallest
        viewer.close()


def measure_training(run: OpenRun, capture: Capture, rasterize: Rasterizer, spells: int, size: tuple[int, int]) -> None:
    live = Live(capture, rasterize, lambda: False, port=0, ready=lambda url: None)
    times: list[float] = []

    def watch(training: train.Training) -> None:
        live(training)
        times.append(time.monotonic())

    cfg = run.config.train
    config = replace(run.config, stop_at=None)
    state = train.train(cfg, train.Job(config=config, watch=watch, options=TrainOptions(log_every=1, preview_every=0)), capture, rasterize)
    took: dict[bool, list[float]] = {True: [], False: []}

    def spell(iterations: int) -> list[float]:
        times.clear()
        while len(times) <= iterations:
            next(state)
        return [b - a for a, b in pairwise(times)]

    spell(FIRST)
    assert live.viewer is not None
    along = list_poses(capture)
    try:
        for _ in range(spells):
            took[False] += spell(SPELL)
            process = start_client(live.viewer.url, 600, size, along)
            while not live.viewer.clients:
                spell(1)
            took[True] += spell(SPELL)
            process.terminate()
            process.wait()
            while live.viewer.clients:
                spell(1)
    finally:
        live.close()
    alone, shown = (statistics.median(took[kind]) for kind in (False, True))
    print(f"training: median iteration {alone * 1e3:.1f} ms alone, {shown * 1e3:.1f} ms with a moving client: {shown / alone:.2f}x")
    alone, shown = (statistics.mean(took[kind]) for kind in (False, True))
    print(f"training: mean iteration {alone * 1e3:.1f} ms alone, {shown * 1e3:.1f} ms with a moving client: {shown / alone:.2f}x")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--data", type=Path, help="path of the capture, if it has moved")
    parser.add_argument("--width", type=int, default=640)
    parser.add_argument("--height", type=int, default=360)
    parser.add_argument("--seconds", type=float, default=8.0)
    parser.add_argument("--spells", type=int, default=6, help="periods of the training; 0 skips it")
    args = parser.parse_args()
    run = run_folder.open_run(args.run, "cpu")
    data = run.config.data if args.data is None else replace(run.config.data, path=args.data)
    capture = captures.load(data, run.config.train.seed)
    rasterize = replace(choose("auto", "cpu"), antialias=run.config.train.antialias)  # type: ignore[type-var]
    size = (args.width, args.height)
    try:
        measure_serving(run, capture, rasterize, args.seconds, size)
        if args.spells:
            measure_training(run, capture, rasterize, args.spells, size)
    finally:
        capture.images.close()


if __name__ == "__main__":
    main()
