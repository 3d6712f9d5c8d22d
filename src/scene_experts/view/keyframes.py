"""The controls that make camera paths: keyframes are set where a user stands, played back, and
saved for `render --path`."""

from __future__ import annotations

import json
import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from scene_experts.core.errors import RunError
from scene_experts.core.io import write_json
from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.geometry.poses import interpolate_poses, make_pose, with_fov
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix
from scene_experts.view import path_files
from scene_experts.view.paths import CameraPath, make_round

SIZE = (1280, 720)  # width and height of the saved path, px
MOST_KEYS = 200
AROUND, ROUND = 24, 16.0  # keyframes and seconds of the path around the scene


@dataclass(frozen=True, eq=False)
class Flight:
    """A path that a client is moved along."""

    keys: tuple[Camera, ...]
    loop: bool  # whether it returns to the first key
    seconds: float  # from one key to the next

    def poses(self, fps: float) -> list[Tensor]:
        """Return the world-to-camera matrices [4, 4] at `fps` frames per second."""
        rotations = torch.stack([key.world_to_cam[:3, :3].T.double() for key in self.keys])
        places = torch.stack([key.position.double() for key in self.keys])
        gaps = len(self.keys) - (0 if self.loop else 1)
        return interpolate_poses(places, rotations, max(2, round(gaps * self.seconds * fps)), loop=self.loop)


@dataclass
class Keyframes:
    """The controls of camera paths."""

    server: Any
    capture: Capture
    folder: Path | None = None  # folder that paths are saved in; None: the working directory
    keys: list[Camera] = field(default_factory=list)
    playing: dict[int, Flight] = field(default_factory=dict)  # by client; a flight that is not here any more stops

    def __post_init__(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self.words: Any = gui.add_markdown("no keyframes")
            add, clear = gui.add_button("add keyframe"), gui.add_button("clear")
            self.seconds: Any = gui.add_number("seconds between keyframes", initial_value=2.0, min=0.1, max=60.0, step=0.1)
            self.loop: Any = gui.add_checkbox("loop", initial_value=False)
            play, save = gui.add_button("play or stop"), gui.add_button("save")
            around = gui.add_button("fly around the scene, or stop")
        add.on_click(lambda event: self.add(event.client))
        clear.on_click(lambda _: self.clear())
        play.on_click(lambda event: self.play(event.client))
        around.on_click(lambda event: self.fly_around(event.client))
        save.on_click(lambda event: self.save(event.client))

    def add(self, client: Any) -> None:
        """Add the camera of a client as a keyframe."""
        if client is None:
            return
        if len(self.keys) >= MOST_KEYS:
            self.words.content = f"a path has at most {MOST_KEYS} keyframes"
            return
        seen = client.camera
        quat = torch.tensor(np.asarray(seen.wxyz), dtype=torch.float64)
        place = torch.tensor(np.asarray(seen.position), dtype=torch.float64)
        model = replace(self.capture.views[0].camera, world_to_cam=make_pose(place, quat_to_matrix(quat / quat.norm())).float())
        self.keys.append(with_fov(model, float(seen.fov), *SIZE))
        self.words.content = f"{len(self.keys)} keyframes"

    def clear(self) -> None:
        """Remove all keyframes, and stop all flights."""
        self.keys.clear()
        self.playing.clear()
        self.words.content = "no keyframes"

    def make_path(self) -> CameraPath:
        """Return the keyframes as a path. `render` and `play` interpolate between them."""
        return CameraPath(tuple(self.keys), 1 / float(self.seconds.value))

    def save(self, client: Any) -> None:
        """Send the path to the browser and write it to a file. A file that cannot be written is
        reported, and the browser has the path."""
        if not self.keys:
            self.words.content = "no keyframes to save; add one first"
            return
        folder = self.folder or Path.cwd()
        path = folder / f"path_{time.strftime('%Y%m%d_%H%M%S')}.json"
        made = path_files.describe_path(self.make_path(), self.capture.world, loop=bool(self.loop.value), play_fps=24.0)
        if client is not None:
            client.send_file_download(path.name, json.dumps(made, indent=2).encode())
        try:
            write_json(path, made)
            self.words.content = f"saved {path}"
        except (RunError, OSError) as error:
            self.words.content = f"sent to the browser only: {error}" if client is not None else f"not saved: {error}"

    def play(self, client: Any) -> None:
        """Move a client along the keyframes, in a thread of its own, or stop it."""
        if client is None or len(self.keys) < 2:
            self.words.content = "add at least two keyframes to play"
            return
        self.toggle(client, Flight(tuple(self.keys), bool(self.loop.value), float(self.seconds.value)))

    def fly_around(self, client: Any) -> None:
        """Move a client along a closed path that fits the capture, or stop it. The keyframes stay
        as they are."""
        if client is not None:
            self.toggle(client, Flight(make_round(self.capture, AROUND).cameras, True, ROUND / AROUND))

    def toggle(self, client: Any, flight: Flight) -> None:
        """Start a flight of a client, or stop the one that is on its way."""
        if not self.stop(client.client_id):
            self.playing[client.client_id] = flight
            threading.Thread(target=self.move_client, args=(client, flight), daemon=True).start()

    def stop(self, client: int) -> bool:
        """Stop the flight of a client. Returns whether there was one."""
        return self.playing.pop(client, None) is not None

    def move_client(self, client: Any, flight: Flight, fps: float = 15.0) -> None:
        """Move a client along its flight. Returns at the end, or when `playing` does not have the
        flight any more."""
        try:
            for pose in flight.poses(fps):
                if self.playing.get(client.client_id) is not flight:
                    return
                rotation, place = pose[:3, :3].T, -(pose[:3, :3].T @ pose[:3, 3])
                with client.atomic():
                    client.camera.wxyz = tuple(matrix_to_quat(rotation).tolist())
                    client.camera.position = tuple(place.tolist())
                time.sleep(1 / fps)
        finally:
            if self.playing.get(client.client_id) is flight:
                self.stop(client.client_id)
