"""The controls beside the picture: what is shown, experts, views, crop, levels, camera paths, and
the curves of a training."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from scene_experts.core.types import Camera
from scene_experts.data.capture import Capture
from scene_experts.geometry.rotation import matrix_to_quat
from scene_experts.scene import Scene, Traits
from scene_experts.training.events import Event, Finished, Stepped, Stopped
from scene_experts.view.keyframes import Keyframes
from scene_experts.view.paint import Look, available_shows
from scene_experts.view.paths import choose_best_view

MOST_FRUSTA = 300
MOST_POINTS = 200_000
STATUS_INTERVAL = 0.5  # seconds between updates of the status line
CURVE_INTERVAL = 1.0  # seconds between updates of the curves
HELP = """**Mouse**: drag to turn, right drag to move, wheel to go nearer.

**Keys**: W A S D move, Q and E go down and up, arrows turn.

**Show** chooses colours, depth, opacity or experts. **Views** goes to a photograph's place; its slider *photograph* draws the
photograph over the scene. *cameras* shows all places; click one to go there. **Crop** hides what is outside a box,
and shows the option of `scene-experts export` that does so in a file.
**Camera path** records places and saves them for `scene-experts render --path FILE`."""
EXPERTS = (
    "{} expert networks share the {}: a router chooses which of them decode each one. "
    "Switch experts off to see what each draws; *Show: experts* colours the scene by expert."
)


class Panel:
    """The controls of the page. Every method may be called from any thread.

    Args:
        server: The viser server.
        capture: The capture whose views are offered.
        current: Returns the scene and the step at which it is drawn.
        changed: Called when the picture must be drawn again.
        go_to_view: Called with the index of a view to move all clients to.
        paths: Folder that camera paths are saved in.
    """

    server: Any
    capture: Capture
    current: Callable[[], tuple[Scene, int]]
    changed: Callable[[], None]
    go_to_view: Callable[[int], None]
    traits: Traits
    status_time: float
    curve_time: float
    charts: list[tuple[str, Any]]
    keyframes: Keyframes
    names: tuple[str, ...]
    switches: list[Any]
    bounds: list[Any]
    pause: Any
    status: Any
    show: Any
    size: Any
    color: Any
    level: Any
    attribute: Any
    wipe: Any
    chosen: Any
    near: Any
    crop: Any
    crop_text: Any

    def __init__(
        self,
        server: Any,
        capture: Capture,
        current: Callable[[], tuple[Scene, int]],
        changed: Callable[[], None],
        go_to_view: Callable[[int], None],
        paths: Path | None = None,
    ) -> None:
        self.server, self.capture, self.current, self.changed, self.go_to_view = server, capture, current, changed, go_to_view
        self.curves: dict[str, list[float]] = {"step": [], "psnr": [], "loss": []}
        self.status_time, self.curve_time, self.charts, self.pause = 0.0, 0.0, [], None
        self.jobs: dict[str, Callable[[], None]] = {}
        self.status = server.gui.add_markdown("")
        with server.gui.add_folder("Help", expand_by_default=False):
            server.gui.add_markdown(HELP)
        scene, step = current()
        self.traits = scene.traits
        with server.gui.add_folder("Show"):
            self.show = self.redraw_on_change(
                server.gui.add_dropdown("what", options=available_shows(self.traits), initial_value="picture")
            )
            self.size = self.redraw_on_change(server.gui.add_slider("height, px", min=120, max=1080, step=20, initial_value=720))
            color = tuple(round(255 * c) for c in capture.background)
            self.color = self.redraw_on_change(server.gui.add_rgb("background", initial_value=color))
        if self.traits.experts:
            self.add_expert_controls(scene, step)
        self.level = None
        if finest := self.traits.levels - 1 if self.traits.levels else 0:
            self.level = self.redraw_on_change(server.gui.add_slider("finest level", min=0, max=finest, step=1, initial_value=finest))
        self.add_view_controls()
        self.add_crop_controls(scene)
        self.keyframes = Keyframes(server, capture, paths)

    def redraw_on_change(self, control: Any) -> Any:
        """Return `control`, whose changes now cause a new picture."""
        control.on_update(lambda _: self.changed())
        return control

    def queue(self, name: str, job: Callable[[], None]) -> None:
        """Let the drawing thread do a longer job, whose time then counts as drawing. A job of the
        same name that waits is replaced."""
        self.jobs[name] = job
        self.changed()

    def run_jobs(self) -> None:
        """Do the jobs that wait."""
        for name in list(self.jobs):
            self.jobs.pop(name)()

    def add_expert_controls(self, scene: Scene, step: int) -> None:
        """Add a choice of the attribute and a switch for each expert."""
        with torch.no_grad():
            attributes = tuple(scene.routing(step, 1))
        gui, numbers = self.server.gui, range(1, self.traits.experts + 1)
        with gui.add_folder("Experts", expand_by_default=False):
            gui.add_markdown(EXPERTS.format(self.traits.experts, self.traits.rows))
            self.attribute = self.redraw_on_change(gui.add_dropdown("of", options=attributes, initial_value=attributes[-1]))
            self.switches = [self.redraw_on_change(gui.add_checkbox(f"expert {number}", initial_value=True)) for number in numbers]
            alone = gui.add_dropdown("only", options=("all", *map(str, numbers)), initial_value="all")

            @alone.on_update
            def _(_: Any) -> None:
                for number, switch in zip(numbers, self.switches):
                    switch.value = alone.value in ("all", str(number))
                self.changed()

    def add_view_controls(self) -> None:
        """Add a choice of the views, the photograph over the picture, and switches for the cameras
        and rows."""
        gui, views = self.server.gui, self.capture.views
        test = set(self.capture.test)
        names = tuple(f"{'test  ' if i in test else 'train '} {view.name}" for i, view in enumerate(views))
        with gui.add_folder("Views"):
            chosen = gui.add_dropdown("view", options=names, initial_value=names[choose_best_view(self.capture)])
            chosen.on_update(lambda _: self.go_to_view(names.index(chosen.value)))
            self.wipe = self.redraw_on_change(gui.add_slider("photograph", min=0.0, max=1.0, step=0.01, initial_value=0.0))
            self.near = self.redraw_on_change(gui.add_checkbox("stay near the photographs", initial_value=True))
            frusta = gui.add_checkbox("cameras", initial_value=False)
            rows = gui.add_checkbox(self.traits.rows, initial_value=False)
        frusta.on_update(lambda _: self.queue("frusta", lambda: self.show_frusta(frusta.value)))
        rows.on_update(lambda _: self.queue("rows", lambda: self.show_rows(rows.value)))
        self.chosen, self.names = chosen, names

    def add_crop_controls(self, scene: Scene) -> None:
        """Add a crop box in the capture's units. Its sliders span the central 99 % of the rows
        along each axis."""
        gui = self.server.gui
        xyz = scene.positions.cpu().float()
        low, high = (
            (torch.quantile(xyz[:: max(1, len(xyz) // 100_000)], q, dim=0) for q in (0.005, 0.995)) if len(xyz) else (xyz.new_zeros(3),) * 2
        )
        least = 1e-3 / self.capture.world.scale
        low, high = (self.capture.world.to_input(corner.double()) for corner in (low, high))
        with gui.add_folder("Crop", expand_by_default=False):
            self.crop = self.redraw_on_change(gui.add_checkbox("crop", initial_value=False))
            self.bounds = []
            for axis in range(3):
                a, b = float(low[axis]), max(float(high[axis]), float(low[axis]) + least)
                slider = gui.add_multi_slider("xyz"[axis], min=a, max=b, step=(b - a) / 200, initial_value=(a, b))
                self.bounds.append(self.redraw_on_change(slider))
            self.crop_text = gui.add_markdown(self.crop_words())
        for slider in self.bounds:
            slider.on_update(lambda _: setattr(self.crop_text, "content", self.crop_words()))

    # --- values of the controls

    def read_look(self) -> Look:
        """Return what the picture shows."""
        only, attribute = None, "color"
        if self.traits.experts:
            attribute = self.attribute.value
            if not all(switch.value for switch in self.switches):
                only = tuple(e for e, switch in enumerate(self.switches) if switch.value)
        box = None
        if self.crop.value:
            (x0, y0, z0), (x1, y1, z1) = self.capture.world.from_input(self.read_box()).tolist()
            box = ((x0, y0, z0), (x1, y1, z1))
        return Look(show=self.show.value, attribute=attribute, only=only, box=box)

    def read_box(self) -> torch.Tensor:
        """Return the lower and the upper corner of the crop box, [2, 3] float64, in the capture's
        own frame."""
        return torch.tensor([sorted(map(float, bound.value)) for bound in self.bounds], dtype=torch.float64).T

    def crop_words(self) -> str:
        """Return the option of `scene-experts export` that keeps what is in the crop box."""
        return f"`--crop box:{','.join(f'{value:.9g}' for value in self.read_box().flatten().tolist())}`"

    def read_background(self) -> tuple[float, float, float]:
        """Return the background colour, RGB in [0, 1]."""
        r, g, b = self.color.value
        return (r / 255, g / 255, b / 255)

    def read_height(self) -> int:
        """Return the largest height of a picture in px."""
        return int(self.size.value)

    def read_wipe(self) -> float:
        """Return the fraction of the picture that the photograph covers, in [0, 1]."""
        return float(self.wipe.value)

    def stays_near(self) -> bool:
        """Return whether pictures are drawn only from where photographs were taken."""
        return bool(self.near.value)

    def read_finest(self) -> int | None:
        """Return the finest level to draw, or None for all levels."""
        return None if self.level is None or self.level.value >= self.level.max else int(self.level.value)

    # --- what is shown beside the picture

    def report_picture(self, seconds: float, camera: Camera) -> None:
        """Show the size and the time of a picture. During a training the status line shows the
        training instead."""
        now = time.monotonic()
        if now - self.status_time > STATUS_INTERVAL and not self.charts:
            self.status_time = now
            self.show_status(f"{camera.width} x {camera.height} px, {1000 * seconds:.0f} ms")

    def show_status(self, text: str) -> None:
        """Show a text (Markdown) at the top of the panel."""
        self.status.content = text

    def show_frusta(self, visible: bool) -> None:
        """Show or hide the cameras of the capture (at most MOST_FRUSTA). A click on one moves the
        clients there."""
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
            frustum.on_click(lambda _, i=i: self.go_to_view(i))

    def show_rows(self, visible: bool) -> None:
        """Show or hide the positions of the rows (at most MOST_POINTS) as points."""
        if not visible:
            self.server.scene.remove_by_name("/anchors")
            return
        xyz = self.current()[0].positions.cpu().float()
        xyz = xyz[:: max(1, -(-len(xyz) // MOST_POINTS))]
        self.server.scene.add_point_cloud("/anchors", xyz.numpy(), (230, 159, 0), point_size=0.002 * self.capture.extent)

    # --- during a training

    def add_training_controls(self) -> None:
        """Add a pause switch and the curves of a training."""
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

    def is_paused(self) -> bool:
        """Return whether the user paused the training."""
        return bool(self.pause is not None and self.pause.value)

    def end_pause(self) -> None:
        """Let a paused training go on."""
        self.pause.value = False

    def follow(self, event: Event) -> None:
        """Update the curves and the status line from an event of the training."""
        match event:
            case Stepped():
                self.curves["step"].append(float(event.step))
                self.curves["psnr"].append(math.nan if event.psnr is None else event.psnr)
                self.curves["loss"].append(sum(event.terms.values()))
                if time.monotonic() - self.curve_time > CURVE_INTERVAL:
                    self.curve_time = time.monotonic()
                    self.update_curves(event)
                    self.changed()
            case Stopped() | Finished():
                self.show_status(f"training ended at iteration {event.step:,}")
                self.changed()
            case _:
                pass

    def update_curves(self, event: Stepped) -> None:
        """Show the latest iteration in the status line and in the curves, which have at most about
        500 points."""
        terms = " ".join(f"{name} {value:.4f}" for name, value in event.terms.items())
        self.show_status(f"iteration {event.step:,}, {event.anchors:,} {self.traits.rows}, {100 * event.active:.0f} % active\n\n{terms}")
        every = max(1, len(self.curves["step"]) // 500)
        for key, plot in self.charts:
            plot.data = (np.array(self.curves["step"][::every]), np.array(self.curves[key][::every]))
