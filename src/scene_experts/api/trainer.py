"""`train` and `Trainer`: a recipe and a capture to a run."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypedDict, Unpack

from scene_experts.api import checked, recording
from scene_experts.api.backend import Device, OwnState, Raster, device_of
from scene_experts.api.capture import Capture, load_capture
from scene_experts.api.command_line import command_of
from scene_experts.api.recipe import Recipe, recipe
from scene_experts.api.run import Run
from scene_experts.core.console import LastingConsole
from scene_experts.core.errors import InputError
from scene_experts.render import choose
from scene_experts.training import run_folder
from scene_experts.training.background import with_background
from scene_experts.training.config import RunConfig, with_numbers
from scene_experts.training.events import Event
from scene_experts.training.job import Job
from scene_experts.training.memory import forget_peak, reuse_freed
from scene_experts.training.nearest import with_near_plane
from scene_experts.training.options import TrainOptions
from scene_experts.training.progress import TrainingProgress
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.state import Training


class Trainer:
    """A training to iterate over: `for event in trainer` trains, and yields the events.

    `break` pauses the training, and another loop continues it. `stop` saves it and ends it.
    """

    recipe: Recipe
    """The recipe that is trained."""
    capture: Capture
    """The capture that it is trained on."""

    def __init__(
        self,
        method: Recipe | str,
        capture: Capture | str | Path,
        out: str | Path | None = None,
        *,
        resume: bool = False,
        overwrite: bool = False,
        stop_at: int | None = None,
        deterministic: bool = False,
        device: Device = "auto",
        rasterizer: Raster = "auto",
        save_every: int = 5000,
        keep_checkpoints: int = 2,
        preview_every: int = 1000,
        log_every: int = 10,
        max_memory: float = 0.0,
        tensorboard: bool = False,
    ) -> None:
        """Prepare a training. Nothing is trained or written before the first event.

        Args:
            method: A recipe, or the name of one. By name, a scene of the catalog brings its data
                set's numbers (`Capture.numbers`), as in the command.
            capture: A capture, its folder, or "catalog:SCENE".
            out: Run folder to write, as `scene-experts train --out` does. Default: the scene stays
                in memory.
            resume: Continue from the newest whole checkpoint in `out`.
            overwrite: Start again in a folder that holds an earlier run, whose checkpoints are
                removed.
            stop_at: Stop at this iteration of the unchanged schedule; `iterations` of the recipe
                rescales the schedule instead.
            deterministic: Bit-identical results on one machine, resumed or not; a little slower.
                While it computes the next event, torch uses deterministic algorithms.
            device: "cpu", "cuda", or "auto" (CUDA if torch finds it and gsplat is installed).
            rasterizer: "cpu" (compiled), "gsplat" (CUDA), "reference" (plain torch, slow), or
                "auto" (the fastest on the device).
            save_every: Iterations between checkpoints, at least 1.
            keep_checkpoints: Number of checkpoints in `out`/checkpoints; older ones are removed. 0
                keeps all.
            preview_every: Iterations between `Previewed` events; 0 for none.
            log_every: Iterations between `Stepped` events, at least 1.
            max_memory: GiB that the process may reach before growth stops, resident or reserved on
                the GPU; 0 for no limit.
            tensorboard: Write `out`/tensorboard too (needs `pip install
                tensorboard`).

        Raises:
            InputError: A setting is invalid, the capture cannot be used, or the folder cannot hold
                the run.
        """
        self.recipe = recipe(method)
        folder = None if out is None else checked.path("out", out)
        if folder is None and (resume or overwrite or tensorboard):
            raise InputError("expected a run folder `out` for resume, overwrite or tensorboard, found None; name one")
        options = checked.fields(TrainOptions, locals())
        if options.max_memory > 0:
            forget_peak()
        where = device_of(options.device, options.rasterizer)
        rasterize = choose(options.rasterizer, where, antialias=self.recipe.antialias, deterministic=options.deterministic)
        loaded = capture if isinstance(capture, Capture) else load_capture(capture, seed=self.recipe.seed)
        self.capture = loaded.with_seed(self.recipe.seed)
        if isinstance(method, str):
            self.recipe = with_numbers(self.recipe, self.capture.numbers)
        words = command_of(self.recipe, self.capture.data, None if out is None else Path(out), options)
        config = RunConfig.of(self.recipe, self.capture.data, options, words, run_folder.versions())
        recording.check_settings(Job(config, options=options))
        if folder is not None:
            run_folder.check(folder, config, resume, overwrite)
            config = run_folder.as_begun(folder, config) if resume else config
        config, behind = with_background(config, self.capture.loaded)
        config, behind = with_near_plane(config, behind)
        self.capture = Capture(config.data, behind, self.capture.seed, self.capture.numbers)
        self._run = Job(config, folder, where, options=options, begin=self._begin)
        self._rasterize = rasterize
        self._training: Training | None = None
        self._ended = False
        self._own = OwnState(where, options.deterministic)
        self._events = self._train()

    def __iter__(self) -> Iterator[Event]:
        """Return the trainer itself: a loop continues where an earlier one was left."""
        return self

    def __next__(self) -> Event:
        """Train until the next event. Raises StopIteration when the training has ended.

        Random numbers that the caller takes from torch do not change the training, nor it theirs.
        Trainings in several threads take turns, from event to event.
        """
        with self._own():
            return next(self._events)

    @property
    def run(self) -> Run:
        """The scene as it is now. After the end of a training with a folder, the run in that
        folder.

        Raises:
            InputError: The training has not begun: no event was yielded yet.
        """
        training, out = self._training, self._run.out
        if self._ended and out is not None:
            return Run(run_folder.open_run(out, self._run.device), self._run.device, self._rasterize, capture=self.capture)
        if training is None:
            raise InputError("expected a training that has begun, found one without an event; iterate over it first")
        about = (training.capture_id, training.poses)
        opened = OpenRun(out or Path(), self._run.config, training.scene, training.step, training.clock, *about)
        return Run(opened, self._run.device, self._rasterize, capture=self.capture, training=training)

    def stop(self, reason: str = "stop") -> None:
        """End the training after this iteration, and save it if it has a folder. The last event is
        `Stopped`, with the reason."""
        self._run.stop.append(reason)

    def finish(self) -> Run:
        """Train to the end, and return the run."""
        for _ in self:
            pass
        return self.run

    def _begin(self, training: Training) -> None:
        self._training = training

    def _train(self) -> Iterator[Event]:
        reuse_freed()
        yield from recording.train(self._run, self.capture.loaded, self._rasterize)
        self._ended = True
        if self._run.out is not None:
            self._training = None  # the run is in its folder now

    def __repr__(self) -> str:
        step = self._training.step if self._training else 0
        return f"Trainer({self.recipe.recipe!r} on {self.capture.name!r}, step {step:,} of {self.recipe.iterations:,})"


class Settings(TypedDict, total=False):
    """How `train` trains. Each is described at `Trainer`."""

    resume: bool
    overwrite: bool
    stop_at: int | None
    deterministic: bool
    device: Device
    rasterizer: Raster
    save_every: int
    keep_checkpoints: int
    preview_every: int
    log_every: int
    max_memory: float
    tensorboard: bool


def train(
    method: Recipe | str,
    capture: Capture | str | Path,
    out: str | Path | None = None,
    *,
    progress: bool = True,
    **settings: Unpack[Settings],
) -> Run:
    """Train a recipe on a capture.

    Ctrl-C saves a training that has a folder and then raises KeyboardInterrupt; a second Ctrl-C
    does not wait.

    Args:
        method: A recipe, or the name of one. By name, a scene of the catalog brings its data set's
            numbers (`Capture.numbers`), as in the command.
        capture: A capture, its folder, or "catalog:SCENE".
        out: Run folder to write, as `scene-experts train --out` does. Default: the scene stays in
            memory.
        progress: Print iterations, losses and the PSNR of training views.
        settings: `resume`, `overwrite`, `stop_at`, `deterministic`, `device` and the other settings
            of `Trainer`.

    Returns:
        The run.

    Raises:
        InputError: A setting is unknown or invalid, the capture cannot be used, or the folder cannot
            hold the run.
        RunError: A loss is not finite, or a file cannot be written.
    """
    if unknown := sorted(settings.keys() - Settings.__annotations__.keys()):
        raise InputError(
            f"expected settings of a training ({', '.join(Settings.__annotations__)}), found {unknown[0]}; "
            f"numbers of the recipe are given to it: train(recipe(..., {unknown[0]}=...), ...)"
        )
    trainer = Trainer(method, capture, out, **settings)
    console = LastingConsole(markup=False, highlight=False, quiet=not progress)
    with saved_on_interrupt(trainer, out is not None), TrainingProgress(console, out=Path(out) if out is not None else None) as show:
        for event in trainer:
            show(event)
    return trainer.run


@contextmanager
def saved_on_interrupt(trainer: Trainer, on: bool) -> Iterator[None]:
    """Let the first Ctrl-C stop the training, which saves it, and raise KeyboardInterrupt
    afterwards."""
    if not on or threading.current_thread() is not threading.main_thread():
        yield
        return
    asked: list[int] = []

    def stop(number: int, _: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        trainer.stop("SIGINT")

    before = signal.signal(signal.SIGINT, stop)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if asked:
        raise KeyboardInterrupt
