"""The controls that make camera paths: keyframes are set where a user stands, played back, and saved for `render --path`."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.geometry.poses import interpolate_poses, make_pose, with_fov
from scene_experts.geometry.rotation import matrix_to_quat, quat_to_matrix
from scene_experts.view import path_files
from scene_experts.view.paths import CameraPath, make_path

SIZE = (1280, 720)  # width and height of the saved path, px
MOST_KEYS = 200
AROUND, ROUND = 24, 16.0  # keyframes and seconds of the path around the scene


@dataclass
class Keyframes:
    """The controls of camera paths."""

    server: Any
    capture: Capture
    folder: Path | None = None  # folder that paths are saved in; None: the working directory
    keys: list[Camera] = field(default_factory=list)
    playing: set[int] = field(default_factory=set)  # clients that move along the path; they stop when they are removed from here

    def __post_init__(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Camera path", expand_by_default=False):
            self.words: Any = gui.add_markdown("no keyframes")
            add, clear = gui.add_button("add keyframe"), gui.add_button("clear")
            self.seconds: Any = gui.add_number("seconds between keyframes", initial_value=2.0, min=0.1, max=60.0, step=0.1)
            self.loop: Any = gui.add_checkbox("loop", initial_value=False)
            play, save = gui.add_button("play"), gui.add_button("save")
            around = gui.add_button("fly around the scene")
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
        """Remove all keyframes."""
        self.keys.clear()
        self.words.content = "no keyframes"

    def make_path(self) -> CameraPath:
        """Return the keyframes as a path. `render` and `play` interpolate between them."""
        return CameraPath(tuple(self.keys), 1 / float(self.seconds.value))

    def save(self, client: Any) -> None:
        """Write the path to a file and send it to the browser."""
        if not self.keys:
            self.words.content = "no keyframes to save; add one first"
            return
        folder = self.folder or Path.cwd()
        path = folder / f"path_{time.strftime('%Y%m%d_%H%M%S')}.json"
        path_files.write_path(path, self.make_path(), self.capture.world, loop=bool(self.loop.value), play_fps=24.0)
        self.words.content = f"saved {path}"
        if client is not None:
            client.send_file_download(path.name, path.read_bytes())

    def play(self, client: Any) -> None:
        """Move a client along the path, in a thread of its own."""
        if client is None or len(self.keys) < 2:
            self.words.content = "add at least two keyframes to play"
            return
        if client.client_id not in self.playing:
            threading.Thread(target=self.move_client, args=(client,), daemon=True).start()

    def fly_around(self, client: Any) -> None:
        """Replace the keyframes by a closed path that fits the capture, and move a client along it."""
        self.keys = [with_fov(camera, camera.fov, *SIZE) for camera in make_path("auto", self.capture, AROUND).cameras]
        self.loop.value, self.seconds.value = True, ROUND / AROUND
        self.words.content = f"{len(self.keys)} keyframes around the scene"
        self.play(client)

    def move_client(self, client: Any, fps: float = 15.0) -> None:
        """Move a client along the path; returns at its end or when the client leaves."""
        self.playing.add(client.client_id)
        try:
            self._move_client(client, fps)
        finally:
            self.playing.discard(client.client_id)

    def _move_client(self, client: Any, fps: float) -> None:
        rotations = torch.stack([key.world_to_cam[:3, :3].T.double() for key in self.keys])
        places = torch.stack([key.position.double() for key in self.keys])
        gaps = len(self.keys) - (0 if self.loop.value else 1)
        frames = max(2, round(gaps * float(self.seconds.value) * fps))
        for made in interpolate_poses(places, rotations, frames, loop=bool(self.loop.value)):
            if client.client_id not in self.playing:
                return
            rotation, place = made[:3, :3].T, -(made[:3, :3].T @ made[:3, 3])
            with client.atomic():
                client.camera.wxyz = tuple(matrix_to_quat(rotation).tolist())
                client.camera.position = tuple(place.tolist())
            time.sleep(1 / fps)
