"""Shows a training in a browser while it runs. The viewer draws between two iterations, in the
training's own thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from scene_experts.data.capture import Capture
from scene_experts.render import Rasterizer
from scene_experts.training.events import Event
from scene_experts.view.gate import Gate
from scene_experts.view.server import Viewer

SHARE = 0.12  # fraction of the training time that drawing may take
SERVING = 0.04  # fraction of one core that the server's thread may use while the training runs


@dataclass
class Live:
    """Draws between the iterations of a training, within its share of the time, and waits while the
    training is paused.

    Call it with the training after each iteration (`Run.watch`). The page can pause the training
    and write camera paths, so its address has a token, also on this machine. A pause ends when the
    last browser leaves.
    """

    capture: Capture
    rasterize: Rasterizer
    stopped: Callable[[], bool]  # returns whether the training was asked to stop
    port: int = 8080
    label: str = "training"
    paths: Path | None = None
    ready: Callable[[str], None] = print  # called with the address
    viewer: Viewer | None = None
    owed: float = 0.0  # seconds of training until drawing is within its share again
    last: float = 0.0  # time of the last call, monotonic seconds

    def __call__(self, training: Any) -> None:
        now = time.monotonic()
        if self.viewer is None:
            current = lambda: (training.scene, training.step)  # noqa: E731
            share = lambda: 0.5 if self.viewer and self.viewer.panel.is_paused() else SERVING  # noqa: E731
            gate = Gate("127.0.0.1", need_token=True, share=share)
            self.viewer = Viewer(self.capture, current, self.rasterize, port=self.port, label=self.label, paths=self.paths, gate=gate)
            self.viewer.panel.add_training_controls()
            self.ready(self.viewer.url + (f" (port {self.port} is taken)" if self.viewer.moved else ""))
            self.last = now
        self.owed, self.last = max(0.0, self.owed - (now - self.last)), now
        if self.owed == 0.0 and self.viewer.has_work(now):
            self.owed = self.viewer.draw(budget=0.01) * (1 / SHARE - 1)
            self.last = time.monotonic()
        while self.viewer.panel.is_paused() and not self.stopped():
            self.viewer.changed.wait(0.05)
            self.viewer.changed.clear()
            self.viewer.draw()
            self.last, self.owed = time.monotonic(), 0.0
            if not self.viewer.clients:
                self.viewer.panel.end_pause()

    def follow(self, event: Event) -> None:
        """Pass an event of the training on to the page."""
        if self.viewer is not None:
            self.viewer.panel.follow(event)

    def close(self) -> None:
        """Stop the server, if it was started."""
        if self.viewer is not None:
            self.viewer.close()
