"""A page on one port: the scene drawn here by the fast rasteriser, sent as pictures to any browser (viser). No display or GPU needed.

One thread draws, for all clients in turn: either the thread of `serve`, or the training's own between two iterations. A client that moves
gets small pictures at once and the full one when it rests.
"""

from __future__ import annotations

import logging
import threading
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.evaluate.pictures import to_8bit
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix
from scene_experts.render import Rasterizer
from scene_experts.scene import Draws, Scene
from scene_experts.view.paint import paint
from scene_experts.view.panel import Panel
from scene_experts.view.paths import around, best_view, pose, with_fov

log = logging.getLogger(__name__)

REST = 0.15  # seconds without a movement after which the full picture is drawn
GOAL = 1 / 25  # seconds that a picture may take while its client moves
SMALLEST = 0.2  # of the full size


def viser() -> Any:
    """The module that serves the page. Raises InputError with what to install where it is missing."""
    try:
        import viser as module
    except ImportError as error:
        raise InputError("expected viser to show scenes in a browser, found none; pip install 'scene-experts[viewer]'") from error
    return module


def check_port(port: int) -> None:
    """Raises InputError for a number that is no port; 0 lets the system choose."""
    if not 0 <= port <= 65535:
        raise InputError(f"expected --port between 0 and 65535, found {port}; choose another")


@dataclass
class Client:
    """One browser: where it looks from, and what it was last sent."""

    handle: Any
    moved: float = 0.0  # when its camera last changed (monotonic seconds)
    wanted: bool = True  # whether something changed since its last picture
    full: bool = False  # whether the last picture was of full size
    seconds_a_pixel: float = 1e-7  # of drawing and sending, measured
    at_view: int | None = None  # the captured view it stands at
    arriving: float = 0.0  # until then its camera's messages are of being put there

    def moving(self, now: float) -> bool:
        return now - self.moved < REST


@dataclass
class Viewer:
    """Serves a scene. `current()` gives the scene and the step to draw it at, which change while it trains."""

    capture: Capture
    current: Callable[[], tuple[Scene, int]]
    rasterize: Rasterizer
    host: str = "127.0.0.1"
    port: int = 8080
    label: str = "scene-experts"
    height: int = 1080  # px of a full picture, at most
    paths: Path | None = None  # where camera paths are saved
    draws: Draws | None = None  # the scene frozen, where it does not train
    clients: dict[int, Client] = field(default_factory=dict)
    changed: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        module = viser()
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a browser that goes away is no fault of ours
        warnings.filterwarnings("ignore", message=r"Queued an? \w+ on a closed connection")
        try:
            self.server = module.ViserServer(host=self.host, port=self.port, label=self.label, verbose=False)
        except OSError as error:
            raise RunError(f"cannot serve on {self.host}:{self.port}: {error.strerror or error}; choose another --port") from error
        self.lock = threading.Lock()
        self.device = next(iter(self.current()[0].table.params.values())).device
        seen = around(self.capture)
        self.server.scene.set_up_direction(tuple(seen.up.tolist()))
        self.centre, self.reach = seen.centre, float((seen.positions - seen.centre).norm(dim=1).median())
        self.first = best_view(self.capture)  # where clients begin
        self.panel = Panel(self.server, self.capture, self.current, self.touch, self.go, self.paths)
        self.server.on_client_connect(self.connect)
        self.server.on_client_disconnect(self.disconnect)

    @property
    def moved(self) -> bool:
        """Whether the port that was asked for was taken, so that another is in use."""
        return self.port != 0 and self.server.get_port() != self.port

    @property
    def url(self) -> str:
        return f"http://{'localhost' if self.host in ('127.0.0.1', '0.0.0.0') else self.host}:{self.server.get_port()}"

    # --- clients

    def connect(self, handle: Any) -> None:
        client = Client(handle)
        with self.lock:
            self.clients[handle.client_id] = client
        self.go(self.first, [client])

        @handle.camera.on_update
        def _(_: Any) -> None:
            now = time.monotonic()
            client.moved, client.wanted = now, True
            if now > client.arriving:
                client.at_view = None
            self.changed.set()

    def disconnect(self, handle: Any) -> None:
        with self.lock:
            self.clients.pop(handle.client_id, None)

    def touch(self) -> None:
        """Something that every client sees has changed."""
        with self.lock:
            for client in self.clients.values():
                client.wanted, client.full = True, False
        self.changed.set()

    def go(self, view: int, clients: list[Client] | None = None) -> None:
        """Put clients (all by default) where a photograph was taken."""
        camera = self.capture.views[view].camera
        rotation = camera.world_to_cam[:3, :3].T.double()
        place = camera.position.double()
        distance = max(float((self.centre - place) @ rotation[:, 2]), 0.1 * self.reach)
        with self.lock:
            chosen = list(self.clients.values()) if clients is None else clients
        for client in chosen:
            with client.handle.atomic():
                client.handle.camera.wxyz = tuple(matrix_to_quat(rotation).tolist())
                client.handle.camera.position = tuple(place.tolist())
                client.handle.camera.look_at = tuple((place + distance * rotation[:, 2]).tolist())
                client.handle.camera.fov = camera.fov
            client.at_view, client.arriving = view, time.monotonic() + 1.0
            client.wanted, client.moved = True, time.monotonic()
        self.changed.set()

    # --- drawing

    def due(self, now: float) -> list[Client]:
        """Clients to draw for: those that moved or whose scene changed, and those that came to rest with a small picture."""
        with self.lock:
            return [c for c in self.clients.values() if c.wanted or (not c.full and not c.moving(now))]

    def draw(self, budget: float = float("inf")) -> float:
        """Draw for every client that is due, within `budget` seconds (one picture may go over); returns the seconds it took."""
        began = time.monotonic()
        for client in self.due(began):
            if time.monotonic() - began >= budget:
                self.changed.set()
                break
            try:
                self.one(client, min(GOAL, max(budget, 0.004)))
            except InputError as error:  # a look that this scene does not have
                client.wanted, client.full = False, True
                self.panel.tell(str(error))
            except Exception as error:  # one client's trouble (it went away, it sent nonsense) is not the others'
                client.wanted, client.full = False, True
                log.debug("client %s: %r", client.handle.client_id, error, exc_info=error)
        return time.monotonic() - began

    def one(self, client: Client, goal: float) -> None:
        """Draw and send one picture."""
        began = time.monotonic()
        moving = client.moving(began)
        client.wanted = False
        camera = self.camera(client)
        full = camera.width * camera.height
        if moving:
            share = min(1.0, max(SMALLEST, (goal / (client.seconds_a_pixel * full)) ** 0.5))
            camera = with_fov(camera, camera.fov, max(16, round(camera.width * share)), max(16, round(camera.height * share)))
        scene, step = self.current()
        picture = to_8bit(self.picture(client, scene, step, camera))
        if client.handle.client_id not in self.clients:  # it went away meanwhile
            return
        client.handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=75 if moving else 95)
        client.full = not moving
        taken = (time.monotonic() - began) / (camera.width * camera.height)
        client.seconds_a_pixel += 0.5 * (taken - client.seconds_a_pixel)
        self.panel.drawn(time.monotonic() - began, camera)

    @torch.no_grad()
    def picture(self, client: Client, scene: Scene, step: int, camera: Camera) -> torch.Tensor:
        """What the client is to see: the scene as the panel asks, the photograph over the left of it where it stands at a view."""
        look, background = self.panel.look(), torch.tensor(self.panel.background(), device=self.device)
        with scene.at_level(self.panel.finest()):  # meanwhile alone: a training's own scene must go on with all its levels
            picture = paint(scene, camera.to(self.device), step, self.rasterize, background, look, self.draws).cpu()
        part = self.panel.photograph()
        if part > 0 and client.at_view is not None:
            photo = self.photograph(client.at_view, camera)
            cut = round(part * camera.width)
            picture[:, :cut] = photo[:, :cut]
        return picture

    def photograph(self, view: int, camera: Camera) -> torch.Tensor:
        """A photograph as `camera` would see it from the same place: each of its pixels looked up (outside: grey)."""
        frame, source = self.capture.frame(view), self.capture.views[view].camera
        rgb = frame.rgb.permute(2, 0, 1)[None].float() / 255
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        u = (x - camera.cx) / camera.fx * source.fx + source.cx
        v = (y - camera.cy) / camera.fy * source.fy + source.cy
        grid = torch.stack([u / source.width * 2 - 1, v / source.height * 2 - 1], -1)[None]
        found = torch.nn.functional.grid_sample(rgb, grid, mode="bilinear", align_corners=False, padding_mode="zeros")[0].permute(1, 2, 0)
        inside = (grid[0].abs() <= 1).all(-1)
        return torch.where(inside[..., None], found, 0.5)

    def camera(self, client: Client) -> Camera:
        """The client's camera in full size. Raises ValueError for one that is none (a broken or hostile message)."""
        seen = client.handle.camera
        quat, place = torch.tensor(np.asarray(seen.wxyz), dtype=torch.float64), torch.tensor(np.asarray(seen.position), dtype=torch.float64)
        fov, aspect = float(seen.fov), float(seen.aspect)
        fine = quat.shape == (4,) and place.shape == (3,) and bool(quat.isfinite().all()) and bool(place.isfinite().all())
        if not fine or float(quat.norm()) < 1e-6 or not 0.01 < fov < 3.1 or not 0.1 < aspect < 10:
            raise ValueError("no camera")
        height = max(16, min(self.height, int(getattr(seen, "image_height", 0) or self.height), self.panel.height()))
        width = max(16, round(height * aspect))
        model = self.capture.views[0].camera
        model = replace(model, world_to_cam=pose(place, quat_to_matrix(quat / quat.norm())).float())
        return with_fov(model, fov, width, height)

    # --- life

    def serve(self, until: Callable[[], bool] = lambda: False) -> None:
        """Draw whatever is asked for until `until()` (for ever by default); returns at Ctrl-C."""
        try:
            while not until():
                self.changed.wait(0.05)
                self.changed.clear()
                self.draw()
        except KeyboardInterrupt:
            pass

    def close(self) -> None:
        self.server.stop()
