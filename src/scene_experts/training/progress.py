"""Shows the progress of a training, and of other long work, on the terminal or as plain lines if
there is no terminal."""

from __future__ import annotations

import time
from pathlib import Path

from rich.console import Console
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeRemainingColumn
from rich.progress import Progress as TaskBar
from rich.text import Text

from scene_experts.core.progress import Speedometer
from scene_experts.scene import Traits
from scene_experts.training.course import Course
from scene_experts.training.events import Densified, Event, Exported, Finished, Previewed, Saved, Started, Stepped, Stopped

SMOOTHING = 0.9  # weight of the previous value in the running means of loss and PSNR


class TrainingProgress:
    """Shows the events of a training. Use it as a context manager and call it with each event.

    Args:
        console: Where the events are shown. A terminal has one line that is updated in place.
        every: Seconds between lines if the console is not a terminal.
        out: The folder of the run, for the place of the first picture; without it no place is
            shown.
    """

    console: Console
    every: float
    out: Path | None
    live: Live | None
    total: int
    first: int
    began: float
    printed: float
    loss: dict[str, float]
    psnr: float | None
    traits: Traits
    pictured: bool
    pace: Speedometer
    cost: Speedometer
    course: Course

    def __init__(self, console: Console, every: float = 15.0, out: Path | None = None) -> None:
        self.console, self.every, self.out, self.pictured = console, every, out, False
        self.live = Live(console=console, refresh_per_second=4, transient=True) if console.is_terminal else None
        self.total, self.first, self.began, self.printed = 0, 0, time.perf_counter(), 0.0
        self.loss, self.psnr = {}, None
        self.traits = Traits("", "rows")
        self.pace, self.cost, self.course = Speedometer(), Speedometer(), Course(1)

    def __enter__(self) -> TrainingProgress:
        if self.live:
            self.live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.live:
            self.live.stop()

    def __call__(self, event: Event) -> None:
        """Show an event."""
        match event:
            case Started():
                self.total, self.first, self.began = event.total, event.step, time.perf_counter()
                self.pace, self.cost, self.course = Speedometer(), Speedometer(), event.course or Course(event.total)
                verb = f"resumed at iteration {event.step:,}" if event.step else "started"
                self.traits, rows = event.traits, event.traits.rows
                lattice = f" on a lattice of {event.traits.voxel:.3g}" if event.traits.voxel else ""
                self.print_line(f"{verb}: {event.anchors:,} {rows}{lattice}, {event.total:,} iterations")
                if event.start:
                    self.print_line(f"start: {event.start}")
                if event.decode:
                    self.print_line(f"decode: {event.decode}")
                if event.gradients:
                    self.print_line(f"step: {event.gradients}")
            case Stepped():
                self.show_step(event)
            case Densified():
                if event.edit.capped:
                    rows = self.traits.rows
                    self.print_line(
                        f"iteration {event.step:,}: the cap on {rows} or memory limited growth to {event.edit.anchors:,} {rows}"
                    )
            case Saved():
                self.print_line(f"saved {event.path}")
            case Stopped():
                kept = not self.out or any((self.out / "checkpoints").glob("ckpt_*.safetensors"))
                state = "the run is saved: continue with --resume, or use it as it is" if kept else "nothing is saved yet: train again"
                self.print_line(f"stopped at iteration {event.step:,} ({event.reason}); {state}")
            case Exported():
                self.print_line(f"wrote {event.path}")
                for note in event.notes:
                    self.print_line(note)
            case Finished():
                if event.step > self.first:  # a run that was already complete has nothing to tell
                    self.print_line(f"finished {event.step:,} iterations in {format_duration(event.seconds)}")
            case Previewed():
                if self.out and not self.pictured:
                    self.pictured = True
                    self.print_line(f"first picture: {self.out / 'previews' / f'{event.step:06d}.png'}")

    def show_step(self, event: Stepped) -> None:
        """Show an iteration: running means of losses and training PSNR, the number of rows, speed
        and remaining time."""
        for name, value in event.terms.items():
            self.loss[name] = SMOOTHING * self.loss.get(name, value) + (1 - SMOOTHING) * value
        if event.psnr is not None:
            self.psnr = event.psnr if self.psnr is None else SMOOTHING * self.psnr + (1 - SMOOTHING) * event.psnr
        psnr = "-" if self.psnr is None else f"{self.psnr:.2f}"
        done = self.course.spent(event.step)
        speed, pace = self.pace(event.step), self.cost(done)
        left = "-:-- left"
        if speed is not None and pace is not None:
            left = f"{format_duration((self.course.spent(self.total) - done) / pace)} left  {speed:.1f} it/s"
        terms = " ".join(f"{name} {value:.4f}" for name, value in self.loss.items())
        active = f"active {100 * event.active:.0f} %  " if self.traits.activation else ""
        line = (  # a narrow terminal cuts the end off
            f"{event.step:>6,}/{self.total:,}  {left}  training PSNR {psnr}  {self.traits.rows} {event.anchors:,}  {active}{terms}"
        )
        if self.live:
            self.live.update(Text(line, no_wrap=True, overflow="ellipsis"))
        elif time.perf_counter() - self.printed > self.every or event.step == self.total:
            self.printed = time.perf_counter()
            self.print_line(line)

    def print_line(self, text: str) -> None:
        """Print a line above the line that is updated in place."""
        self.console.print(text, highlight=False, soft_wrap=True)


class ProgressBar:
    """Shows the progress of other work: a bar on a terminal, otherwise a line now and then.

    Use it as a context manager and call it with the name of the work, how much is done and how much
    there is.

    Args:
        console: Where the progress is shown.
        every: Seconds between lines if the console is not a terminal.
    """

    console: Console
    every: float
    printed: float
    bar: TaskBar
    task: TaskID
    what: str
    pace: Speedometer

    def __init__(self, console: Console, every: float = 15.0) -> None:
        self.console, self.every, self.printed = console, every, time.monotonic()
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        self.bar = TaskBar(*columns, console=console, transient=True)
        self.task = self.bar.add_task("opening", total=None)
        self.what, self.pace = "", Speedometer()

    def __enter__(self) -> ProgressBar:
        if self.console.is_terminal:
            self.bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.console.is_terminal:  # a bar that was never started would leave an empty line
            self.bar.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show that `done` of `total` parts of the work `what` are done."""
        if what.partition(" (")[0] != self.what.partition(" (")[0]:  # another work: the speed of the last one says nothing
            self.pace = Speedometer()
            self.bar.reset(self.task)
        self.what, speed = what, self.pace(done)
        self.bar.update(self.task, description=what, completed=done, total=total)
        if not self.console.is_terminal and time.monotonic() - self.printed > self.every:
            self.printed = time.monotonic()
            left = "" if speed is None or "left" in what else f", about {format_duration(max(0, total - done) / speed)} left"
            self.console.print(f"{what}: {done} of {total}{left}", highlight=False, soft_wrap=True)


def format_duration(seconds: float) -> str:
    """Format seconds as h:mm:ss or m:ss."""
    whole = int(seconds + 0.5)
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02d}:{whole % 60:02d}" if hours else f"{minutes}:{whole % 60:02d}"
