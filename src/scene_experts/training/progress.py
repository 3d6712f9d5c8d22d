"""What a training, and other long work, says on the terminal: a line that renews itself, or plain lines where there is no terminal."""

from __future__ import annotations

import time

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as TaskBar
from rich.text import Text

from scene_experts.scene import Traits
from scene_experts.training.events import Adjusted, Event, Exported, Finished, Previewed, Saved, Started, Stepped, Stopped


class Progress:
    """Shows training events. Use as a context manager; call it with each event."""

    console: Console
    every: float
    live: Live | None
    total: int
    first: int
    began: float
    printed: float
    traits: Traits

    def __init__(self, console: Console, every: float = 15.0) -> None:
        """every: seconds between lines where there is no terminal."""
        self.console, self.every = console, every
        self.live = Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else None
        self.total, self.first, self.began, self.printed = 0, 0, time.perf_counter(), 0.0
        self.loss: dict[str, float] = {}
        self.psnr: float | None = None
        self.traits = Traits("", "rows")

    def __enter__(self) -> Progress:
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.stop()

    def __call__(self, event: Event) -> None:
        match event:
            case Started():
                self.total, self.first, self.began = event.total, event.step, time.perf_counter()
                verb = f"resumed at iteration {event.step:,}" if event.step else "started"
                self.traits, rows = event.traits, event.traits.rows
                lattice = f" on a lattice of {event.traits.voxel:.3g}" if event.traits.voxel else ""
                self.say(f"{verb}: {event.anchors:,} {rows}{lattice}, {event.total:,} iterations")
            case Stepped():
                self.step(event)
            case Adjusted():
                if event.edit.capped:
                    rows = self.traits.rows
                    what = f"the cap on {rows} or memory held growth back at {event.edit.anchors:,} {rows}"
                    self.say(f"iteration {event.step:,}: {what}")
            case Saved():
                self.say(f"saved {event.path}")
            case Stopped():
                self.say(f"stopped at iteration {event.step:,} ({event.reason}); the run is saved, go on with --resume")
            case Exported():
                self.say(f"wrote {event.path}")
            case Finished():
                self.say(f"finished {event.step:,} iterations in {clock(event.seconds)}")
            case Previewed():
                pass

    def step(self, event: Stepped) -> None:
        keep = 0.9  # of the running mean
        for name, value in event.terms.items():
            self.loss[name] = keep * self.loss.get(name, value) + (1 - keep) * value
        self.psnr = event.psnr if self.psnr is None else keep * self.psnr + (1 - keep) * event.psnr
        speed = (event.step - self.first) / max(time.perf_counter() - self.began, 1e-9)
        left = (self.total - event.step) / max(speed, 1e-9)
        terms = " ".join(f"{name} {value:.4f}" for name, value in self.loss.items())
        active = f"active {100 * event.active:.0f} %  " if self.traits.activation else ""
        line = (
            f"{event.step:>6,}/{self.total:,}  {terms}  PSNR {self.psnr:.2f}  {self.traits.rows} {event.anchors:,}  {active}"
            f"{speed:.1f} it/s  {clock(left)} left"
        )
        if self.live:
            self.live.update(Text(line, no_wrap=True, overflow="ellipsis"))
        elif time.perf_counter() - self.printed > self.every or event.step == self.total:
            self.printed = time.perf_counter()
            self.console.print(line, highlight=False, soft_wrap=True)

    def say(self, text: str) -> None:
        self.console.print(text, highlight=False, soft_wrap=True)


class Bar:
    """How far a piece of work is: a bar on a terminal, a line now and then elsewhere. Use as a context manager and call it."""

    console: Console
    every: float
    said: float
    bar: TaskBar
    task: TaskID

    def __init__(self, console: Console, every: float = 15.0) -> None:
        """every: seconds between lines where there is no terminal."""
        self.console, self.every, self.said = console, every, time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self.bar = TaskBar(*columns, console=console, transient=True)
        self.task = self.bar.add_task("opening", total=None)

    def __enter__(self) -> Bar:
        if self.console.is_terminal:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:  # elsewhere it was never started, and would leave an empty line
            self.bar.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        self.bar.update(self.task, description=what, completed=done, total=total)
        if not self.console.is_terminal and time.monotonic() - self.said > self.every:
            self.said = time.monotonic()
            self.console.print(f"{what}: {done} of {total}", highlight=False, soft_wrap=True)


def clock(seconds: float) -> str:
    """Seconds as h:mm:ss or m:ss."""
    whole = int(seconds + 0.5)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"
