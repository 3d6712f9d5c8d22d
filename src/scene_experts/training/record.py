"""What a training leaves on disk besides checkpoints: metrics.jsonl, previews and, when asked, TensorBoard files."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from PIL import Image

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.io import write_atomic
from scene_experts.data.capture import Capture
from scene_experts.training.events import Adjusted, Event, Previewed, Started, Stepped


class Recorder:
    """Writes training events into a run folder. Use as a context manager; call it with each event."""

    def __init__(self, out: Path, tensorboard: bool, capture: Capture) -> None:
        self.out, self.capture = out, capture
        self.path = out / "metrics.jsonl"
        self.writer: Any = None  # makes the board when the run starts, so that one that cannot start leaves nothing behind
        self.board: Any = None
        if tensorboard:
            try:
                from torch.utils.tensorboard import SummaryWriter
            except ImportError as error:
                raise InputError("expected TensorBoard for --tensorboard, found none; pip install 'scene-experts[tensorboard]'") from error
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
                    self.board = self.writer(str(self.out / "tensorboard"))
            case Stepped():
                self.line({**asdict(event)})
                if self.board:
                    self.scalars(event)
            case Adjusted():
                self.line({"step": event.step, "grown": event.edit.grown, "pruned": event.edit.pruned, "anchors": event.edit.anchors})
            case Previewed():
                picture = Image.fromarray((event.picture * 255 + 0.5).byte().numpy())
                path = self.out / "previews" / f"{event.step:06d}.png"
                write_atomic(path, lambda temporary: picture.save(temporary, format="PNG"))

    def truncate(self, step: int) -> None:
        """Drop lines beyond `step`: a resumed run writes them again."""
        lines = self.path.read_text(errors="replace").splitlines() if self.path.exists() else []  # a power cut may leave anything
        kept = [line for line in lines if _step(line) <= step] if step else []
        write_atomic(self.path, lambda temporary: temporary.write_text("".join(line + "\n" for line in kept)))

    def line(self, value: dict[str, Any]) -> None:
        try:
            with self.path.open("a") as stream:
                stream.write(json.dumps(value) + "\n")
        except OSError as error:
            raise RunError(f"cannot write {self.path}: {error.strerror}; free some space and go on with --resume") from error

    def scalars(self, event: Stepped) -> None:
        values = {f"loss/{k}": v for k, v in event.terms.items()}
        values |= {
            "psnr/train": event.psnr,
            "scene/anchors": event.anchors,
            "scene/gaussians": event.gaussians,
            "scene/active": event.active,
        }
        values |= {f"experts/{a}/{i}": share for a, shares in event.routing.items() for i, share in enumerate(shares)}
        for name, value in values.items():
            self.board.add_scalar(name, value, event.step)


def _step(line: str) -> float:
    """The iteration of a metrics line; infinity where the line was cut off."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")
