"""Serves a scene to browsers (viser). This process draws the pictures, so neither it nor the
browser needs a display or a GPU.

One thread draws for all clients in turn: the thread that calls `serve`, or the training's thread
between two iterations. A client gets small pictures while its camera moves and a full-size picture
when it rests.
"""

from __future__ import annotations

import logging
import socket
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.evaluate.pictures import to_8bit
from scene_experts.geometry.poses import make_pose, with_fov
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix
from scene_experts.render import Rasterizer
from scene_experts.scene import Draws, Scene
from scene_experts.view.gate import Gate, guarding
from scene_experts.view.paint import paint
from scene_experts.view.panel import Panel
from scene_experts.view.paths import analyse_cameras, choose_best_view, median_depth
from scene_experts.view.region import Region, find_region

log: logging.Logger = logging.getLogger(__name__)

REST = 0.15  # seconds without movement after which a full-size picture is drawn
GOAL = 1 / 25  # seconds per picture while the client moves
MOST_PIXELS = 4_000_000  # of a picture
SMALLEST = 0.2  # smallest side of a picture while the client moves, as a fraction of the full size


def import_viser() -> Any:
    """Return the module viser. Raises InputError, which says what to install, if it is missing."""
    try:
        import viser as module
    except ImportError as error:
        raise InputError(f"showing scenes in a browser requires viser: {install_line('viewer')}") from error
    return module


@contextmanager
def quiet() -> Iterator[None]:
    """Hide what viser prints when it starts and stops. Its address would lack the token."""
    from rich import get_console

    console, before = get_console(), get_console().quiet
    console.quiet = True
    try:
        yield
    finally:
        console.quiet = before


def check_port(port: int) -> None:
    """Raise InputError if a number is not a port. 0 lets the system choose one."""
    if not 0 <= port <= 65535:
        raise InputError(f"expected --port between 0 and 65535, found {port}; choose another port")


def check_host(host: str) -> None:
    """Raise InputError if this machine cannot listen on an address. viser would wait for it for
    ever."""
    try:
        family = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, 0), family=family).close()
    except (OSError, UnicodeError) as error:
        why = getattr(error, "strerror", None) or error
        advice = "leave it out, or give 0.0.0.0 for all addresses of this machine"
        raise InputError(f"expected --host as an address of this machine, found '{host}' ({why}); {advice}") from None


@dataclass
class Client:
    """A connected browser: its camera and what it was last sent."""

    handle: Any
    moved: float = 0.0  # when its camera last moved, monotonic seconds
    wanted: bool = True  # whether something has changed since its last picture
    full: bool = False  # whether its last picture had the full size
    seconds_a_pixel: float = 1e-7  # measured time to draw and send
    at_view: int | None = None  # index of the view that it stands at
    arriving: float = 0.0  # until then its camera messages are answers to being moved there

    def is_moving(self, now: float) -> bool:
        """Return whether its camera moved within the last REST seconds."""
        return now - self.moved < REST


@dataclass
class Viewer:
    """Serves a scene to browsers.

    `current()` returns the scene and the step at which it is drawn. Both change during training.
    `gate` decides who is served; by default only pages of this server on this machine, and beyond
    it those that know the token in `url`.
    """

    capture: Capture
    current: Callable[[], tuple[Scene, int]]
    rasterize: Rasterizer
    host: str = "127.0.0.1"
    port: int = 8080
    label: str = "scene-experts"
    height: int = 1080  # largest height of a picture, px
    paths: Path | None = None  # folder that camera paths are saved in
    draws: Draws | None = None  # the frozen scene, if it is not being trained
    gate: Gate = None  # type: ignore[assignment]  # None: the default of `host`
    clients: dict[int, Client] = field(default_factory=dict)
    changed: threading.Event = field(default_factory=threading.Event)

    def __post_init__(self) -> None:
        module = import_viser()
        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a browser that disconnects is not an error
        warnings.filterwarnings("ignore", message=r"Queued an? \w+ on a closed connection")
        self.gate = self.gate or Gate(self.host)
        try:
            with quiet(), guarding(self.gate, f"viser-v{module.__version__}"):
                self.server: Any = module.ViserServer(host=self.host, port=self.port, label=self.label, verbose=False)
        except OSError as error:
            raise RunError(f"cannot serve on {self.host}:{self.port}: {error.strerror or error}; choose another --port") from error
        self.lock: threading.Lock = threading.Lock()
        self.device: torch.device = self.current()[0].table.device
        rig = analyse_cameras(self.capture)
        self.server.scene.set_up_direction(tuple(rig.up.tolist()))
        self.centre: Tensor = rig.centre
        # photographs that were all taken from one point look at nothing in common: the points say
        # how far the scene is
        depth = median_depth(self.capture, rig.positions.mean(0), rig.forward[0])
        self.reach: float = max(float((rig.positions - rig.centre).norm(dim=1).median()), 0.05 * depth)
        self.region: Region = find_region(rig.positions, self.reach)
        self.first: int = choose_best_view(self.capture)  # where clients start
        self.set_start()
        self.panel: Panel = Panel(self.server, self.capture, self.current, self.request_redraw, self.go_to_view, self.paths)
        self.gate.gui = self.server.gui
        self.server.on_client_connect(self.connect)
        self.server.on_client_disconnect(self.disconnect)

    @property
    def moved(self) -> bool:
        """Whether the requested port was taken and another one is used."""
        return self.port != 0 and self.server.get_port() != self.port

    @property
    def url(self) -> str:
        """Address of the page, with the token if one is needed."""
        name = "localhost" if self.host in ("", "0.0.0.0", "::", "127.0.0.1") else self.host
        address = f"http://{f'[{name}]' if ':' in name else name}:{self.server.get_port()}"
        return f"{address}/?token={self.gate.token}" if self.gate.token else address

    # --- clients

    def connect(self, handle: Any) -> None:
        """Add a client and move it to the first view."""
        client = Client(handle)
        with self.lock:
            self.clients[handle.client_id] = client
        self.go_to_view(self.first, [client])

        @handle.camera.on_update
        def _(_: Any) -> None:
            now = time.monotonic()
            client.moved, client.wanted = now, True
            if now > client.arriving and not self.stands_at_view(client):  # a window that changes its size sends a camera too
                client.at_view = None
            self.changed.set()

    def disconnect(self, handle: Any) -> None:
        """Remove a client."""
        with self.lock:
            self.clients.pop(handle.client_id, None)
        self.panel.keyframes.stop(handle.client_id)

    def request_redraw(self) -> None:
        """Draw a new picture for every client."""
        with self.lock:
            for client in self.clients.values():
                client.wanted, client.full = True, False
        self.changed.set()

    def set_start(self) -> None:
        """Let pages open at the first view. A page that still loads when `connect` moves it may
        lose that message."""
        start = getattr(self.server, "initial_camera", None)  # viser 1.0.0 has none
        if start is not None:
            camera = self.capture.views[self.first].camera
            forward = camera.world_to_cam[2, :3].double()
            place = camera.position.double()
            start.position = tuple(place.tolist())
            start.look_at = tuple((place + self.find_distance(self.first) * forward).tolist())
            start.up = tuple((-camera.world_to_cam[1, :3].double()).tolist())
            start.fov = camera.fov

    def find_distance(self, view: int) -> float:
        """Return how far ahead of the camera of a view the point lies that the mouse turns
        around."""
        camera = self.capture.views[view].camera
        forward = camera.world_to_cam[2, :3].double()
        return max(float((self.centre - camera.position.double()) @ forward), 0.1 * self.reach)

    def stands_at_view(self, client: Client) -> bool:
        """Return whether a client still has the pose of the view that it was moved to."""
        if client.at_view is None:
            return False
        camera, seen = self.capture.views[client.at_view].camera, client.handle.camera
        moved = torch.tensor(np.asarray(seen.position), dtype=torch.float64) - camera.position.double()
        turned = matrix_to_quat(camera.world_to_cam[:3, :3].T.double()) @ torch.tensor(np.asarray(seen.wxyz), dtype=torch.float64)
        return float(moved.norm()) <= 1e-4 * self.region.radius and abs(float(turned)) > 1 - 1e-6

    def go_to_view(self, view: int, clients: list[Client] | None = None) -> None:
        """Move clients (None: all) to the camera of a view."""
        camera = self.capture.views[view].camera
        rotation = camera.world_to_cam[:3, :3].T.double()
        place = camera.position.double()
        distance = self.find_distance(view)
        with self.lock:
            chosen = list(self.clients.values()) if clients is None else clients
        for client in chosen:
            self.panel.keyframes.stop(client.handle.client_id)
            with client.handle.atomic():
                client.handle.camera.wxyz = tuple(matrix_to_quat(rotation).tolist())
                client.handle.camera.position = tuple(place.tolist())
                client.handle.camera.look_at = tuple((place + distance * rotation[:, 2]).tolist())
                client.handle.camera.fov = camera.fov
            client.at_view, client.arriving = view, time.monotonic() + 1.0
            client.wanted, client.moved = True, time.monotonic()
        self.changed.set()

    # --- drawing

    def find_due(self, now: float) -> list[Client]:
        """Return the clients that need a picture: something changed, or they rest and have only a
        small picture."""
        with self.lock:
            return [c for c in self.clients.values() if c.wanted or (not c.full and not c.is_moving(now))]

    def has_work(self, now: float) -> bool:
        """Return whether `draw` would do anything."""
        return bool(self.panel.jobs or self.find_due(now))

    def draw(self, budget: float = float("inf")) -> float:
        """Draw for every client that is due and return the seconds taken.

        The first picture is always drawn, and the last one may exceed `budget` seconds.
        """
        began = time.monotonic()
        self.panel.run_jobs()
        for turn, client in enumerate(self.find_due(began)):
            if turn and time.monotonic() - began >= budget:
                self.changed.set()
                break
            try:
                self.draw_client(client, min(GOAL, max(budget, 0.004)))
            except InputError as error:  # the scene cannot show what was chosen
                client.wanted, client.full = False, True
                self.panel.show_status(str(error))
            except Exception as error:  # a client that fails (it disconnected, it sent nonsense) does not affect the others
                client.wanted, client.full = False, True
                log.debug("client %s: %r", client.handle.client_id, error, exc_info=error)
        return time.monotonic() - began

    def draw_client(self, client: Client, goal: float) -> None:
        """Draw and send one picture, within about `goal` seconds while the client moves."""
        began = time.monotonic()
        moving = client.is_moving(began)
        client.wanted = False
        camera = self.read_camera(client)
        full = camera.width * camera.height
        if moving:
            share = min(1.0, max(SMALLEST, (goal / (client.seconds_a_pixel * full)) ** 0.5))
            camera = with_fov(camera, camera.fov, max(16, round(camera.width * share)), max(16, round(camera.height * share)))
        scene, step = self.current()
        picture = to_8bit(self.render_picture(client, scene, step, camera))
        if client.handle.client_id not in self.clients:  # it disconnected meanwhile
            return
        client.handle.scene.set_background_image(picture, format="jpeg", jpeg_quality=75 if moving else 95)
        client.full = not moving
        if client.full:
            self.bring_back(client, camera)
        taken = (time.monotonic() - began) / (camera.width * camera.height)
        client.seconds_a_pixel += 0.5 * (taken - client.seconds_a_pixel)
        self.panel.report_picture(time.monotonic() - began, camera)

    def bring_back(self, client: Client, camera: Camera) -> None:
        """Move a resting client to where its picture was drawn, if it left the region of the
        photographs."""
        place, seen = camera.position.double(), client.handle.camera
        moved = place - torch.tensor(np.asarray(seen.position), dtype=torch.float64)
        if float(moved.norm()) > 1e-4 * self.region.radius:
            client.arriving = time.monotonic() + 1.0
            with client.handle.atomic():
                seen.position = tuple(place.tolist())
                seen.look_at = tuple((place + self.reach * camera.world_to_cam[2, :3].double()).tolist())

    @torch.no_grad()
    def render_picture(self, client: Client, scene: Scene, step: int, camera: Camera) -> torch.Tensor:
        """Draw the picture [H, W, 3] of a client as the panel asks, with the photograph over its
        left part if it stands at a view."""
        look, background = self.panel.read_look(), torch.tensor(self.panel.read_background(), device=self.device)
        with scene.at_level(self.panel.read_finest()):  # only here: a scene in training keeps using all its levels
            picture = paint(scene, camera.to(self.device), step, self.rasterize, background, look, self.draws).cpu()
        part = self.panel.read_wipe()
        if part > 0 and client.at_view is not None:
            photo = self.reproject_photograph(client.at_view, camera)
            cut = round(part * camera.width)
            picture[:, :cut] = photo[:, :cut]
        return picture

    def reproject_photograph(self, view: int, camera: Camera) -> torch.Tensor:
        """Resample the photograph of a view for `camera` at the same pose, [H, W, 3]. Pixels
        outside the photograph are grey."""
        frame, source = self.capture.frame(view), self.capture.views[view].camera
        rgb = frame.rgb.permute(2, 0, 1)[None].float() / 255
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        u = (x - camera.cx) / camera.fx * source.fx + source.cx
        v = (y - camera.cy) / camera.fy * source.fy + source.cy
        grid = torch.stack([u / source.width * 2 - 1, v / source.height * 2 - 1], -1)[None]
        found = torch.nn.functional.grid_sample(rgb, grid, mode="bilinear", align_corners=False, padding_mode="zeros")[0].permute(1, 2, 0)
        inside = (grid[0].abs() <= 1).all(-1)
        return torch.where(inside[..., None], found, 0.5)

    def read_camera(self, client: Client) -> Camera:
        """Return the camera of a client at full size. Raises ValueError for invalid values (a
        broken or hostile message)."""
        seen = client.handle.camera
        quat, place = torch.tensor(np.asarray(seen.wxyz), dtype=torch.float64), torch.tensor(np.asarray(seen.position), dtype=torch.float64)
        fov, aspect = float(seen.fov), float(seen.aspect)
        fine = quat.shape == (4,) and place.shape == (3,) and bool(quat.isfinite().all()) and bool(place.isfinite().all())
        if not fine or float(quat.norm()) < 1e-6 or not 0.01 < fov < 3.1 or not 0.1 < aspect < 10:
            raise ValueError("invalid camera")
        if self.panel.stays_near():
            place = self.region.nearest(place)
        height = max(16, min(self.height, int(getattr(seen, "image_height", 0) or self.height), self.panel.read_height()))
        height = min(height, int((MOST_PIXELS / aspect) ** 0.5))
        width = max(16, round(height * aspect))
        model = self.capture.views[0].camera
        model = replace(model, world_to_cam=make_pose(place, quat_to_matrix(quat / quat.norm())).float())
        return with_fov(model, fov, width, height)

    # --- serving

    def serve(self, until: Callable[[], bool] = lambda: False) -> None:
        """Draw until `until()` returns True or Ctrl-C is pressed."""
        try:
            while not until():
                self.changed.wait(0.05)
                self.changed.clear()
                self.draw()
        except KeyboardInterrupt:
            pass

    def close(self) -> None:
        """Stop the server."""
        with quiet():
            self.server.stop()
