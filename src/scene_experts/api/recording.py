"""Trains into a run folder and writes everything that belongs there. `scene-experts train` and the
Python API both call it."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import torch

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.data.capture import Capture
from scene_experts.files.registry import exported_files, formats_of
from scene_experts.files.result_folder import DESCRIPTION
from scene_experts.files.scene_folder import result_warnings, write_result_folder
from scene_experts.render import Rasterizer
from scene_experts.training import loop, run_folder
from scene_experts.training.config import check
from scene_experts.training.events import Event, Exported, Finished, Started
from scene_experts.training.job import Job
from scene_experts.training.memory import give_back, used_bytes
from scene_experts.training.record import Recorder


def train(run: Job, capture: Capture, rasterize: Rasterizer) -> Iterator[Event]:
    """Train the recipe of `run.config` on a capture; yields the events of the training.

    With a folder `run.out`: hold it, write config.json, metrics.jsonl, previews, checkpoints and,
    once the training is complete, the Scaffold-GS layout (or that of the recipe's family). Nothing
    is written before the first event. Without one, nothing is written.

    Raises InputError if the folder cannot hold the run, and RunError if a file cannot be written.
    """
    options = run.options
    if run.out is not None and options.resume:
        run = replace(run, config=run_folder.as_begun(run.out, run.config))
    if run.out is None or not run.group.first:  # process 0 writes all files
        yield from loop.train(run.config.train, run, capture, rasterize)
        return
    finished, complete = None, False
    with ExitStack() as folder, Recorder(run.out, options.tensorboard) as record:
        for event in loop.train(run.config.train, run, capture, rasterize):
            if isinstance(event, Started):  # the training can start: from here on the folder may change
                ended = options.resume and event.step >= event.total
                complete = ended and is_exported(run.out, event.step)
                folder.enter_context(run_folder.held(run.out))
                config = run_folder.as_trained(run.out, run.config) if ended else run.config
                run_folder.prepare(run.out, config, options.resume, options.overwrite, exported_files(run.out))
            record(event)
            if isinstance(event, Finished):
                finished = event  # yielded last; the loop ends first and frees its memory
            else:
                yield event
        if finished is not None:
            if not complete:
                if run.max_memory > 0:
                    give_back()
                exported = export_layout(run.out, capture)
                yield replace(exported, notes=prepare_exports(run.out, capture, rasterize, run.device))
            yield finished


def is_exported(out: Path, step: int) -> bool:
    """Return whether the folder holds the complete layout of the iteration `step`. Its description
    and the cameras are written last."""
    layout = out / "point_cloud" / f"iteration_{step}"
    return all(path.is_file() for path in (layout / "point_cloud.ply", layout / DESCRIPTION, out / "cameras.json"))


def export_layout(out: Path, capture: Capture) -> Exported:
    """Write the newest checkpoint of a run folder in the layout that other tools read. capture: as it
    was loaded."""
    opened = run_folder.open_run(out)
    written = write_result_folder(opened, run_folder.at_refined_poses(capture, opened.scene))
    return Exported(opened.step, written, tuple(result_warnings(opened)))


def prepare_exports(out: Path, capture: Capture, rasterize: Rasterizer, device: str) -> tuple[str, ...]:
    """Measure what later exports of a trained run need and keep it in its folder. Returns a
    sentence for each measurement. capture: as it was loaded."""
    opened = run_folder.open_run(out)
    capture = run_folder.at_refined_poses(capture, opened.scene)
    formats = formats_of(opened.scene.traits.family).values()
    made = [format.prepare(opened, capture, rasterize, device) for format in formats if format.prepare is not None]
    return tuple(filter(None, made))


def check_settings(run: Job) -> None:
    """Raises InputError, naming the flag, for invalid settings."""
    check_fields(run.options)
    if run.max_memory > 0 and not used_bytes(torch.device("cpu")):
        raise InputError(f"expected a system that reports a process's memory for --max-memory, found {sys.platform}; use --max-anchors")
    check(run.config.train)
