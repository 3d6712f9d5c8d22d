"""What `make` trains: how large, how long, on which photographs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from scene_experts.api.capture import Capture, load_capture
from scene_experts.api.recipe import Recipe, recipe
from scene_experts.bench.advice import Advice, suggest
from scene_experts.bench.machine import measure_share
from scene_experts.core import checkpoint
from scene_experts.core.errors import InputError
from scene_experts.data.prepare import FEW
from scene_experts.data.views import typical_size
from scene_experts.making.budget import LEAST, TimeBudget, find_slowness, plan_training
from scene_experts.sfm.drift import drifts
from scene_experts.training import run_folder
from scene_experts.training.config import RunConfig
from scene_experts.training.course import find_course
from scene_experts.training.events import Stepped
from scene_experts.training.recipes import PROPOSED


@dataclass(frozen=True)
class TrainingPlan:
    """What is trained."""

    place: Path
    split: str
    size: tuple[int, int]  # of the whole photographs, px
    capture: Capture
    recipe: Recipe
    advice: Advice | None = None  # what was estimated
    slow: float = 1.0  # times that the machine takes of it, as far as known
    begun: bool = False  # by an earlier call

    @property
    def held(self) -> int:
        """How many photographs are held out."""
        return len(self.capture.test_cameras)

    def fit(self, have: float | None, slow: float = 1.0) -> TrainingPlan:
        """Return the plan for `have` seconds on a machine that takes `slow` times the estimate."""
        views = len(self.capture.train_cameras)
        advice = plan_training(*self.size, views, have, slow)
        resolution = f"longest:{advice.side}" if advice.side else "auto"
        capture = load_capture(self.place, split=self.split, resolution=resolution)
        chosen = recipe(PROPOSED, iterations=advice.iterations, exposure=self.recipe.exposure)
        if advice.minutes is None and have is not None:
            slow = suggest(*self.size, views).iterations / advice.iterations  # of what is trained: `have` may ask for fewer or more
        return replace(self, capture=capture, recipe=chosen, advice=advice, slow=slow)

    def corrected(self, event: Stepped, left: float) -> TrainingPlan | None:
        """Return another plan for the `left` seconds, if the speed until now says that this one takes
        much more or less and the other one pays."""
        minutes = self.advice.minutes if self.advice else None
        course = find_course(self.recipe.scaled(), self.capture.train_cameras)
        slow = find_slowness(course, event.step, event.seconds, minutes, event.seconds + left)
        if slow is None:
            return None
        other = self.fit(left, slow if minutes else slow * self.slow)
        same = other.recipe.iterations == self.recipe.iterations and other.capture.data.resolution == self.capture.data.resolution
        return other if not same and self.pays(other, event.step) else None

    def pays(self, other: TrainingPlan, step: int) -> bool:
        """Return whether another plan, begun now, ends sooner than this one from `step` on, or is
        for a machine that is faster than was known."""
        if other.slow < self.slow or self.advice is None or self.advice.minutes is None or other.advice is None:
            return True
        return (other.advice.minutes or 0.0) < self.advice.minutes * (1 - step / self.recipe.iterations)


def prepare(place: Path, folder: Path, budget: TimeBudget, scores: bool, say: Callable[[str], None]) -> TrainingPlan:
    """Return what is trained: a run that has begun, or what fits the budget.

    Raises InputError if the run in the folder was begun with other photographs held out, or if
    scores are asked for and there are too few photographs to hold any out.
    """
    split = "auto" if scores else "none"  # auto: lists beside the poses, such as those of panoramas, else every 8th
    if (folder / "config.json").is_file():
        begun = run_folder.read_config(folder)
        capture = load_capture(place, split=begun.data.split, resolution=begun.data.resolution, seed=begun.train.seed)
        if begun.data.path.is_dir() and not begun.data.path.samefile(place):
            other = load_capture(begun.data.path, split=begun.data.split, resolution=begun.data.resolution, seed=begun.train.seed)
            if other.loaded.fingerprint() != capture.loaded.fingerprint():
                raise InputError(f"expected the scene of {place} in {folder.parent}, found one of {begun.data.path}; choose another --out")
        if bool(capture.test_cameras) is not scores:
            told = "some were" if capture.test_cameras else "none was"
            raise InputError(
                f"expected a run with the same photographs held out in {folder}, found one where {told}; "
                f"{'leave --scores out' if scores else 'add --scores'}, or choose another --out"
            )
        say(f"training: {describe_begun(folder, begun)}")
        return TrainingPlan(place, begun.data.split, (0, 0), capture, begun.train, begun=True)
    whole = load_capture(place, split=split)
    if scores and not whole.test_cameras and len(whole.train_cameras) >= FEW:  # lists beside the poses hold none out
        split = "mod8"
        whole = load_capture(place, split=split)
    if scores and not whole.test_cameras:
        raise too_few(len(whole.train_cameras))
    size = typical_size((camera.width, camera.height) for camera in whole.cameras)
    first = TrainingPlan(place, split, size, whole, recipe(PROPOSED, exposure=drifts(place)))
    share = measure_share(torch.get_num_threads())
    plan = first.fit(budget.for_training(first.held), 1 / share)
    held = f", {len(whole.test_cameras)} held out" if scores else ""
    about = f", {told}" if plan.advice and (told := plan.advice.tell(share)) else ""
    learned = ", their exposures" if plan.recipe.exposure else ""
    least = " (the fewest; the time is too short for more)" if plan.recipe.iterations == LEAST else ""
    what = f"{plan.recipe.iterations:,} iterations{least}, {plan.capture.data.resolution}, {len(whole.train_cameras)} photographs{learned}"
    say(f"training: {plan.recipe.recipe}, {what}{held}{about}")
    return plan


def too_few(photographs: int) -> InputError:
    """Return the error of so few photographs that none can be held out for --scores."""
    few = f"found {photographs}, so few that all are trained on"
    return InputError(f"expected at least {FEW} photographs for --scores, {few}; leave --scores out")


def describe_begun(folder: Path, config: RunConfig) -> str:
    """Say how far the training in a run folder is, and how to get another one."""
    saved, iterations = checkpoint.latest(folder / "checkpoints"), config.train.iterations
    step = 0 if saved is None else int(saved.stem.rpartition("_")[2])
    state = f"that in {folder} is complete" if step >= iterations else f"continues that in {folder} at iteration {step:,}"
    again = f"--minutes does not change it; to train anew, remove {folder} and repeat the command, the poses are kept"
    return f"{state}: {iterations:,} iterations, {config.data.resolution}; {again}"
