"""Writes what a training leaves on disk besides checkpoints: metrics.jsonl, previews and, if
requested, TensorBoard files."""

from __future__ import annotations

import errno
import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from PIL import Image

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.extras import install_line
from scene_experts.core.io import write_atomic
from scene_experts.training.events import Densified, Event, Previewed, Started, Stepped


class Recorder:
    """Writes training events into a run folder. Use it as a context manager and call it with each
    event.

    Args:
        out: The run folder.
        tensorboard: Also write TensorBoard files. Raises InputError if TensorBoard is not
            installed.
    """

    path: Path

    def __init__(self, out: Path, tensorboard: bool) -> None:
        self.out = out
        self.path = out / "metrics.jsonl"
        self.writer: Any = None  # class of the board, which is created when the training starts, so that a failed start leaves no files
        self.board: Any = None
        if tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise InputError(f"--tensorboard requires TensorBoard: {install_line('tensorboard')}") from error
            self.writer = SummaryWriter

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        if self.board:
            self.board.close()

    def __call__(self, event: Event) -> None:
        match event:
            case Started():
                self.truncate(event.step)
                if self.writer:
                    self.board = self.writer(str(self.out / "tensorboard"), purge_step=event.step + 1)  # hides what is written again
            case Stepped():
                self.write_line(asdict(event))
                if self.board:
                    self.write_scalars(event)
            case Densified():
                self.write_line({"step": event.step, "grown": event.edit.grown, "pruned": event.edit.pruned, "anchors": event.edit.anchors})
            case Previewed():
                picture = Image.fromarray((event.picture * 255 + 0.5).byte().numpy())
                path = self.out / "previews" / f"{event.step:06d}.png"
                write_atomic(path, lambda temporary: picture.save(temporary, format="PNG"))

    def truncate(self, step: int) -> None:
        """Remove the lines after `step`, which a resumed run writes again."""
        lines = (
            self.path.read_text(errors="replace").splitlines() if self.path.exists() else []
        )  # a power failure may leave arbitrary bytes
        kept = [line for line in lines if _read_step(line) <= step] if step else []
        write_atomic(self.path, lambda temporary: temporary.write_text("".join(line + "\n" for line in kept)))

    def write_line(self, value: dict[str, Any]) -> None:
        """Append a line of JSON to metrics.jsonl. Raises RunError if the file cannot be written."""
        try:
            with self.path.open("a") as stream:
                stream.write(json.dumps(value) + "\n")
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            advice = "free some space" if full else f"look whether {self.path.parent} is still there and may be written"
            raise RunError(f"cannot write {self.path}: {error.strerror}; {advice}, and continue with --resume") from error

    def write_scalars(self, event: Stepped) -> None:
        """Write the values of an iteration to TensorBoard."""
        values = {f"loss/{k}": v for k, v in event.terms.items()}
        values |= {
            "psnr/train": event.psnr,
            "scene/anchors": event.anchors,
            "scene/gaussians": event.gaussians,
            "scene/active": event.active,
        }
        values |= {f"experts/{a}/{i}": share for a, shares in event.routing.items() for i, share in enumerate(shares)}
        for name, value in ((name, value) for name, value in values.items() if value is not None):
            self.board.add_scalar(name, value, event.step)


def _read_step(line: str) -> float:
    """Return the iteration of a line, or infinity for an incomplete line."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")
