"""`make`: photographs or a video to a page: poses, training, scores, page, report."""

from __future__ import annotations

import shlex
import threading
import zlib
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field, fields
from numbers import Real
from pathlib import Path
from statistics import fmean
from time import monotonic
from typing import Any

from scene_experts.api.recipe import recipe
from scene_experts.api.run import Run
from scene_experts.api.trainer import Trainer
from scene_experts.bench.advice import LIMIT
from scene_experts.core.errors import InputError, RunError
from scene_experts.core.fields import flag_of
from scene_experts.core.io import read_json, write_json
from scene_experts.core.progress import Progress
from scene_experts.core.reading.budget import HEAD
from scene_experts.core.reading.source import opening
from scene_experts.core.signals import handled
from scene_experts.data.capture import name_capture
from scene_experts.data.match import EXTENSIONS
from scene_experts.data.prepare import FEW
from scene_experts.data.readers import is_capture
from scene_experts.files.export import export_several
from scene_experts.files.options import Options
from scene_experts.making.budget import LOOK, PAGE_GUESS, TRAINING, TimeBudget, Whole, guess_scores
from scene_experts.making.plan import TrainingPlan, prepare, too_few
from scene_experts.sfm.copies import leave_copies_out
from scene_experts.sfm.folders import SOURCE, list_files
from scene_experts.sfm.lacking import explain_lacking
from scene_experts.sfm.options import SfmOptions, SourceOptions
from scene_experts.sfm.panoramas import cuts
from scene_experts.sfm.photos import HEIC, find_photos
from scene_experts.sfm.reconstruct import NOTE, check_request, reconstruct
from scene_experts.training import run_folder
from scene_experts.training.events import Event, Started, Stepped
from scene_experts.training.recipes import PROPOSED

MARKED = 1 << 16  # bytes at the beginning of a photograph whose checksum tells it from others
CAPTURE, RUN, PAGE = "capture", "run", "scene.html"
PLAIN = SourceOptions()
SAVE_EVERY = 1000  # iterations that a killed training loses at most
RECENT = 200  # iterations whose time counts as that of one at the end


@dataclass(frozen=True)
class MadeScene:
    """What was made, and where it is."""

    page: Path
    """One HTML file that shows the scene in any browser."""
    run: Path
    """The run folder, for `open_run` and every command."""
    capture: Path
    """The photographs with their poses."""
    report: Path | None
    """A page with scores and curves; None unless scores were asked for."""
    psnr: float | None
    """PSNR in dB: of the held-out views if scores were asked for, else of the last training
    views."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time by stage: poses, training, scores, page. 0 for what was there already."""


def make(
    source: str | Path,
    out: str | Path | None = None,
    *,
    minutes: float | None = None,
    scores: bool = False,
    options: SourceOptions = PLAIN,
    say: Callable[[str], None] = print,
    progress: Progress = lambda what, done, total: None,
) -> MadeScene:
    """Make a page with a 3D scene from photographs or a video.

    A call that was interrupted is continued by the same call.

    Args:
        source: Folder of photographs, a video, or a capture.
        out: Folder to write. Default: the name of the source with "-scene", in this folder.
        minutes: Time for the whole, above 0. It decides iterations, resolution and effort; poses
            take what they take. Default: what `info` proposes, with half of its iterations.
        scores: Hold out every 8th photograph of at least 12, and score it. Default: train on all.
        options: What the photographs or the video need: frames of a video, panoramas, matching.
        say: Called with each message.
        progress: Called with the name of the work, how much is done and how much there is.

    Returns:
        What was made.

    Raises:
        InputError: The photographs cannot be used, or `out` holds something else.
        RunError: COLMAP fails, a loss is not finite, or a file cannot be written.
    """
    if not isinstance(options, SourceOptions):
        raise InputError(f"expected options as SourceOptions, found {options!r}; write for example SourceOptions(frames=30)")
    if minutes is not None and not (isinstance(minutes, Real) and minutes > 0):
        raise InputError(f"expected minutes above 0, found {minutes!r}; give for example 10")
    budget, source = TimeBudget(None if minutes is None else 60 * minutes), Path(source)
    folder = Path(out) if out is not None else Path(f"{name_source(source)}-scene")
    took: dict[str, float] = {}
    show, began = Whole(progress), monotonic()
    show.later, show.least = (PAGE_GUESS + 60 * LIMIT if minutes is None else PAGE_GUESS), lambda: budget.left or 0.0
    if scores:
        check_enough(source, folder, options)
    place = find_poses(source, folder, options, say, show)
    took["poses"], show.least = monotonic() - began, lambda: 0.0
    plan = prepare(place, folder / RUN, budget, scores, say)
    rest = PAGE_GUESS + guess_scores(plan.held)
    show.later, began = rest if budget.left is None else budget.left - (budget.for_training(plan.held) or 0.0), monotonic()
    run, psnr = train(plan, folder / RUN, budget, show, say)
    took["training"] = monotonic() - began
    report, began, show.later = None, monotonic(), 0.0
    if scores:
        show("scores", 0, plan.held)
        psnr = run.evaluate(lpips=True).psnr
        report = run.report()
    took["scores"] = monotonic() - began
    began = monotonic()
    page = write_page(folder, Options(measure=False, title=name_source(source)), show)
    took["page"] = monotonic() - began
    return MadeScene(page, folder / RUN, place, report, psnr, took)


def name_source(source: Path) -> str:
    """Return what a scene of photographs, a video or a capture is called."""
    if source.is_dir():  # a date may have dots
        return name_capture(source) if is_capture(source) else source.resolve().name
    return source.resolve().stem


def check_enough(source: Path, folder: Path, options: SourceOptions) -> None:
    """Raise InputError if a folder has too few photographs to hold any out: before poses are sought,
    which may take long. Panoramas have lists of views of their own."""
    if not source.is_dir() or is_capture(source) or is_capture(folder / CAPTURE) or len(list_files(source, folder)) >= 2 * FEW:
        return  # what is not known here is known when the poses are
    found, _ = leave_copies_out(source, find_photos(source, exclude=folder))
    if len(found) < FEW and not cuts(found, SfmOptions(**asdict(options))):
        raise too_few(len(found))


def find_poses(source: Path, folder: Path, options: SourceOptions, say: Callable[[str], None], progress: Progress) -> Path:
    """Return the capture: the source if it is one, or that of an earlier call, or a new one.

    Raises InputError where the poses that are there were found in another way.
    """
    if (source / SOURCE).is_file() and (source / CAPTURE).is_dir():
        raise InputError(
            f"expected photographs or a video, found {source}, which `make` wrote; give its photographs again, or its {source / CAPTURE}"
        )
    if source.is_dir() and is_capture(source):
        if asked := list_changes(asdict(PLAIN), options):
            raise InputError(
                f"expected photographs or a video with {asked[0][0]}, found the capture {source}, which has poses; leave it out"
            )
        return source
    if source.is_dir() and source.resolve() == folder.resolve():
        raise InputError(
            f"expected a folder for the scene that is not that of the photographs, found {folder} for both; choose another --out"
        )
    place, note, given = folder / CAPTURE, folder / SOURCE, describe_source(source, folder)
    if is_capture(place):
        made_of = read_json(note, "note of a scene") if note.is_file() else None
        made_of = made_of if isinstance(made_of, dict) else {}
        files = made_of.get("files")
        if made_of.get("source") != given["source"] and not (files and isinstance(files, dict) and not tell_changes(files, given["files"])):
            other = f"that of {made_of['source']}" if "source" in made_of else "one of an unknown source"
            raise InputError(f"expected the scene of {given['source']} in {folder}, found {other}; choose another --out")
        expect_same(place, options)
        say(f"poses: those in {place}")
        if isinstance(files, dict) and source.exists() and (changed := tell_changes(files, given["files"])):
            anew = f"to make it anew, remove {place} and {folder / RUN} and repeat the command"
            say(f"warning: since then {changed}; the scene is that of the earlier photographs; {anew}")
        return place
    check_request(source, place, overwrite=False)
    folder.mkdir(parents=True, exist_ok=True)
    write_json(note, given)  # before the capture: a call that is killed between the two goes on
    try:
        found = reconstruct(source, place, SfmOptions(**asdict(options)), few=recipe(PROPOSED).dense_views, say=say, progress=progress)
    except InputError:
        forget_empty(folder, place, note)
        raise
    say(f"poses: {found['with_pose']} of {found['photographs']} photographs, {found['points']:,} points")
    for line in explain_lacking(found, f"--matching exhaustive --out {shlex.quote(f'{folder}-2')}"):
        say(line)
    return place


def describe_source(source: Path, folder: Path) -> dict[str, Any]:
    """What tells photographs from others: their place, and of each file outside of `folder`, by name,
    the number of its bytes and a checksum of the first."""
    files = [source] if source.is_file() else list_files(source, folder) if source.is_dir() else []
    kept = [path for path in files if path == source or path.suffix.lower() in (*EXTENSIONS, *HEIC)]
    names = {path: path.name if path == source else path.relative_to(source).as_posix() for path in kept}
    return {"source": str(source.resolve()), "files": {names[path]: _mark(path) for path in sorted(kept)}}


def _mark(path: Path) -> list[int]:
    with opening(path, HEAD, "photograph") as source:
        return [path.stat().st_size, zlib.crc32(source.head(MARKED))]


def tell_changes(before: dict[str, Any], now: dict[str, list[int]]) -> str:
    """Say how many files are new, gone and changed; "" for none. Older notes have the numbers of bytes
    alone."""
    same = lambda name: before[name] in (now[name], now[name][0])  # noqa: E731
    counts = (
        (len(now.keys() - before.keys()), "new"),
        (len(before.keys() - now.keys()), "gone"),
        (sum(not same(name) for name in before.keys() & now.keys()), "changed"),
    )
    found = [f"{many} {'photograph is' if many == 1 else 'photographs are'} {how}" for many, how in counts if many]
    return " and ".join(found)


def forget_empty(folder: Path, place: Path, note: Path) -> None:
    """Remove the folder of a call that could use nothing, unless something is in it."""
    if place.is_dir() and not any(place.iterdir()):
        place.rmdir()
    if set(folder.iterdir()) == {note}:
        note.unlink()
        folder.rmdir()


def list_changes(before: Any, options: SourceOptions) -> list[tuple[str, Any, Any]]:
    """Return the options whose value is another one than in `before`, the options of an earlier call
    by name: their flags, the value before and the value now. What `before` lacks counts as equal."""
    known = before if isinstance(before, dict) else {}
    now = [(f.name, getattr(options, f.name)) for f in fields(options)]
    return [(flag_of(name), known[name], value) for name, value in now if name in known and known[name] != value]


def expect_same(place: Path, options: SourceOptions) -> None:
    """Raise InputError if the capture was made with other options."""
    note = read_json(place / NOTE, "note of a capture") if (place / NOTE).is_file() else None
    for flag, before, now in list_changes(note.get("options") if isinstance(note, dict) else None, options):
        raise InputError(
            f"expected {flag} {before}, with which the poses in {place} were found, found {now}; give {flag} {before}, "
            f"or choose another --out"
        )


def train(plan: TrainingPlan, folder: Path, budget: TimeBudget, progress: Whole, say: Callable[[str], None]) -> tuple[Run, float | None]:
    """Train. Where the first tenth shows that the machine is slower or faster than estimated, the
    training begins anew, once, with what fits the time.

    Returns the run, and the mean PSNR of the last training views.
    """
    settled = plan.begun
    while True:
        other: TrainingPlan | None = None
        begun = plan.begun
        trainer = Trainer(plan.recipe, plan.capture, folder, resume=begun, overwrite=not begun, preview_every=0, save_every=SAVE_EVERY)
        recent: list[Stepped] = []
        for event in saved_when_interrupted(trainer):
            if isinstance(event, Started):
                progress.course = event.course
            if not isinstance(event, Stepped):
                continue
            progress(TRAINING, event.step, plan.recipe.iterations)
            recent = [*(one for one in recent if event.step - one.step <= RECENT), event]
            left = budget.for_training(plan.held)
            if not settled and left is not None and event.step >= LOOK * plan.recipe.iterations:
                settled = True
                other = plan.corrected(event, left)
                if other:
                    trainer.stop("another training fits the time")
        if other is None:
            break
        how = "slower" if other.slow > plan.slow else "faster"
        plan, now = other, f"{other.recipe.iterations:,} iterations, {other.capture.data.resolution}"
        say(f"the machine is {how} than estimated: the training begins anew, {now}")
    known = [one.psnr for one in recent if one.psnr is not None]
    psnr = fmean(known) if known else None
    return trainer.run, psnr


def saved_when_interrupted(trainer: Trainer) -> Iterator[Event]:
    """Yield the events of a training. The first signal that ends a command saves it and then raises
    KeyboardInterrupt, the second raises it at once."""
    asked: list[int] = []

    def stop(number: int, _: object) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        trainer.stop("interrupted")

    with handled(stop) if threading.current_thread() is threading.main_thread() else nullcontext():
        yield from trainer
    if asked:
        raise KeyboardInterrupt


def write_page(folder: Path, options: Options, progress: Progress) -> Path:
    """Write the page, unless a page of this run is there."""
    run, page = folder / RUN, folder / PAGE
    newest = max(path.stat().st_mtime for path in (run / "checkpoints").glob("ckpt_*.safetensors"))
    if page.is_file() and page.stat().st_mtime > newest:
        return page
    progress("page", 0, 1)
    opened: Any = run_folder.open_run(run)
    written = export_several(opened, ("html",), page, options, tell=progress)
    if not written:
        raise RunError(f"expected a page at {page}, found none written; repeat the command")
    return page
