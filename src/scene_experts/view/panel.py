"""The controls beside the picture: what to show, whose experts, where to stand, crop, levels, paths, and the training's curves."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.geometry.rotation import matrix_to_quat
from scene_experts.scene import Scene
from scene_experts.scene.anchors.mlp import ATTRIBUTES
from scene_experts.training.events import Event, Finished, Stepped, Stopped
from scene_experts.view.keyframes import Keyframes
from scene_experts.view.paint import MODES, Look
from scene_experts.view.paths import best_view

MOST_FRUSTA = 300
MOST_POINTS = 200_000
EVERY = 1.0  # seconds between changes of the curves


class Panel:
    """The page's controls; every method may be called from any thread."""

    def __init__(
        self,
        server: Any,
        capture: Capture,
        current: Callable[[], tuple[Scene, int]],
        changed: Callable[[], None],
        go: Callable[[int], None],
        paths: Path | None = None,
    ) -> None:
        self.server, self.capture, self.current, self.changed, self.go = server, capture, current, changed, go
        self.curves: dict[str, list[float]] = {"step": [], "psnr": [], "loss": []}
        self.said, self.followed, self.charts, self.pause = 0.0, 0.0, [], None
        self.status = server.gui.add_markdown("")
        scene, _ = current()
        self.experts = scene.traits.experts
        with server.gui.add_folder("Show"):
            self.mode = self.on(server.gui.add_dropdown("what", options=self.modes(scene), initial_value="picture"))
            self.size = self.on(server.gui.add_slider("height, px", min=120, max=1080, step=20, initial_value=720))
            colour = tuple(round(255 * c) for c in capture.background)
            self.colour = self.on(server.gui.add_rgb("background", initial_value=colour))
        if self.experts:
            self.expert_controls()
        if count := scene.traits.levels:
            self.level = self.on(server.gui.add_slider("finest level", min=0, max=count - 1, step=1, initial_value=count - 1))
        else:
            self.level = None
        self.view_controls()
        self.crop_controls(scene)
        self.keyframes = Keyframes(server, capture, paths)

    def on(self, control: Any) -> Any:
        """A control whose change redraws."""
        control.on_update(lambda _: self.changed())
        return control

    def modes(self, scene: Scene) -> tuple[str, ...]:
        """What this scene can show."""
        usable = {"experts": self.experts > 0, "entropy": self.experts > 0, "activation": scene.traits.activation}
        return tuple(mode for mode in MODES if usable.get(mode, True))

    def expert_controls(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Experts"):
            self.attribute = self.on(gui.add_dropdown("of", options=ATTRIBUTES, initial_value="color"))
            self.switches = [self.on(gui.add_checkbox(f"expert {e + 1}", initial_value=True)) for e in range(self.experts)]
            alone = gui.add_dropdown("alone", options=("all", *(str(e + 1) for e in range(self.experts))), initial_value="all")

            @alone.on_update
            def _(_: Any) -> None:
                for e, switch in enumerate(self.switches):
                    switch.value = alone.value in ("all", str(e + 1))
                self.changed()

    def view_controls(self) -> None:
        gui, views = self.server.gui, self.capture.views
        names = tuple(f"{'test  ' if i in set(self.capture.test) else 'train '} {view.name}" for i, view in enumerate(views))
        with gui.add_folder("Views"):
            chosen = gui.add_dropdown("view", options=names, initial_value=names[best_view(self.capture)])
            chosen.on_update(lambda _: self.go(names.index(chosen.value)))
            self.wipe = self.on(gui.add_slider("photograph", min=0.0, max=1.0, step=0.01, initial_value=0.0))
            frusta = gui.add_checkbox("cameras", initial_value=False)
            anchors = gui.add_checkbox(self.current()[0].traits.rows, initial_value=False)
        frusta.on_update(lambda _: self.show_frusta(frusta.value))
        anchors.on_update(lambda _: self.show_anchors(anchors.value))
        self.chosen, self.names = chosen, names

    def crop_controls(self, scene: Scene) -> None:
        gui = self.server.gui
        xyz = scene.positions.cpu().float()
        low, high = (
            (torch.quantile(xyz[:: max(1, len(xyz) // 100_000)], q, dim=0) for q in (0.005, 0.995)) if len(xyz) else (xyz.new_zeros(3),) * 2
        )
        with gui.add_folder("Crop", expand_by_default=False):
            self.crop = self.on(gui.add_checkbox("crop", initial_value=False))
            self.bounds = []
            for axis in range(3):
                a, b = float(low[axis]), max(float(high[axis]), float(low[axis]) + 1e-3)
                slider = gui.add_multi_slider("xyz"[axis], min=a, max=b, step=(b - a) / 200, initial_value=(a, b))
                self.bounds.append(self.on(slider))

    # --- what is asked for

    def look(self) -> Look:
        only = None
        if self.experts and not all(switch.value for switch in self.switches):
            only = tuple(e for e, switch in enumerate(self.switches) if switch.value)
        box = None
        if self.crop.value:
            ends = [sorted(map(float, bound.value)) for bound in self.bounds]
            box = ((ends[0][0], ends[1][0], ends[2][0]), (ends[0][1], ends[1][1], ends[2][1]))
        attribute = self.attribute.value if self.experts else "color"
        return Look(self.mode.value, attribute, only, box)  # type: ignore[arg-type]

    def background(self) -> tuple[float, float, float]:
        r, g, b = self.colour.value
        return (r / 255, g / 255, b / 255)

    def height(self) -> int:
        return int(self.size.value)

    def photograph(self) -> float:
        return float(self.wipe.value)

    def finest(self) -> int | None:
        """The finest level to draw; None for all of them."""
        return None if self.level is None or self.level.value >= self.level.max else int(self.level.value)

    # --- what is shown beside the picture

    def drawn(self, seconds: float, camera: Camera) -> None:
        now = time.monotonic()
        if now - self.said > 0.5 and not self.charts:  # a training tells of itself
            self.said = now
            self.tell(f"{camera.width} x {camera.height} px, {1000 * seconds:.0f} ms")

    def tell(self, text: str) -> None:
        self.status.content = text

    def show_frusta(self, visible: bool) -> None:
        chosen = np.linspace(0, len(self.capture.views) - 1, min(len(self.capture.views), MOST_FRUSTA)).round().astype(int)
        for i in sorted({int(i) for i in chosen}):
            name, view = f"/cameras/{i}", self.capture.views[i]
            if not visible:
                self.server.scene.remove_by_name(name)
                continue
            rotation = view.camera.world_to_cam[:3, :3].T
            frustum = self.server.scene.add_camera_frustum(
                name,
                fov=view.camera.fov,
                aspect=view.camera.width / view.camera.height,
                scale=0.03 * self.capture.extent,
                color=(213, 94, 0) if i in self.capture.test else (0, 114, 178),
                wxyz=matrix_to_quat(rotation).numpy(),
                position=view.camera.position.numpy(),
            )
            frustum.on_click(lambda _, i=i: self.go(i))

    def show_anchors(self, visible: bool) -> None:
        if not visible:
            self.server.scene.remove_by_name("/anchors")
            return
        xyz = self.current()[0].positions.cpu().float()
        xyz = xyz[:: max(1, -(-len(xyz) // MOST_POINTS))]
        self.server.scene.add_point_cloud("/anchors", xyz.numpy(), (230, 159, 0), point_size=0.002 * self.capture.extent)

    # --- while it trains

    def train(self) -> None:
        """Add the training's controls."""
        from viser import uplot

        gui = self.server.gui
        self.status = gui.add_markdown("waiting for the first iteration")
        self.pause = gui.add_checkbox("pause", initial_value=False)
        self.pause.on_update(lambda _: self.changed())
        nothing = np.zeros(2)
        with gui.add_folder("Training", expand_by_default=True):
            for key, title in (("psnr", "PSNR of training views, dB"), ("loss", "loss")):
                series = (uplot.Series(label="iteration"), uplot.Series(label=key, stroke="#0072b2", width=1))
                plot = gui.add_uplot((nothing, nothing), series, title=title, aspect=1.8, scales={"x": uplot.Scale(time=False, auto=True)})
                self.charts.append((key, plot))

    def paused(self) -> bool:
        return bool(self.pause is not None and self.pause.value)

    def event(self, event: Event) -> None:
        """Follow a training."""
        match event:
            case Stepped():
                self.curves["step"].append(float(event.step))
                self.curves["psnr"].append(event.psnr)
                self.curves["loss"].append(sum(event.terms.values()))
                if time.monotonic() - self.followed > EVERY:
                    self.followed = time.monotonic()
                    self.redraw(event)
                    self.changed()  # the scene has moved on
            case Stopped() | Finished():
                self.tell(f"training ended at iteration {event.step:,}")
                self.changed()
            case _:
                pass

    def redraw(self, event: Stepped) -> None:
        terms = " ".join(f"{name} {value:.4f}" for name, value in event.terms.items())
        self.tell(
            f"iteration {event.step:,}, {event.anchors:,} {self.current()[0].traits.rows}, {100 * event.active:.0f} % active\n\n{terms}"
        )
        step = max(1, len(self.curves["step"]) // 500)
        for key, plot in self.charts:
            plot.data = (np.array(self.curves["step"][::step]), np.array(self.curves[key][::step]))
