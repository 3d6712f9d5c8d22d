"""The training loop. It yields events, saves checkpoints and resumes runs. It does not depend on
any method."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts.core.errors import RunError
from scene_experts.core.schedule import passes
from scene_experts.core.types import Camera, Mode
from scene_experts.data.capture import Capture
from scene_experts.render import Rasterizer, for_training
from scene_experts.scene import Scene
from scene_experts.scene.anchors.quantise import ROUNDED
from scene_experts.scene.poses import at_pose, attach
from scene_experts.strategy.survey import Survey, TrainingPhoto
from scene_experts.training.batch import Direct, check_batch, make_exchange
from scene_experts.training.config import Train
from scene_experts.training.course import find_course
from scene_experts.training.direct import DirectStep
from scene_experts.training.early import shrink
from scene_experts.training.events import Densified, Event, Finished, Previewed, Saved, Started, Stopped
from scene_experts.training.guard import check_finite, explain, find_broken
from scene_experts.training.job import Job, last_iteration
from scene_experts.training.losses import Sample, compute_terms
from scene_experts.training.measure import Iteration, measure_step, without_graph
from scene_experts.training.memory import anchor_cap, give_back, peak_bytes
from scene_experts.training.resident import AHEAD, Resident
from scene_experts.training.sensitivity import MOST_VIEWS, evenly, find_sensitivity
from scene_experts.training.shards import Sharded, check_shard
from scene_experts.training.start import begin, uses_depth
from scene_experts.training.state import Training, save
from scene_experts.training.trial import fit_memory

log: logging.Logger = logging.getLogger(__name__)


def train(cfg: Train, run: Job, capture: Capture, rasterize: Rasterizer) -> Iterator[Event]:
    """Train a scene on a capture, from scratch or from the newest valid checkpoint of the run.

    Args:
        cfg: The settings before scaling. This function scales the schedule.
        run: What is trained, where and how.
        capture: The views and points to train on.
        rasterize: The rasteriser.

    Yields:
        The events of the training. The first is `Started`; the last is `Finished` or `Stopped`.

    Raises:
        InputError: The settings, the capture or the checkpoint cannot be used, or the processes
            cannot share a batch evenly.
        RunError: Another process has ended, a loss or a parameter is not finite, or a checkpoint
            cannot be written.
    """
    cfg = cfg.scaled()
    folder = run.out / "checkpoints" if run.out else None
    rasterize = for_training(rasterize, cfg.growth.absolute, depth=uses_depth(cfg, capture))
    training = run.group.agree(lambda: _begin(cfg, run, capture, folder, rasterize))
    exchange = start_exchange(training, run)
    total = last_iteration(cfg, run)
    writes = folder is not None and run.group.first
    run.begin(training)
    about = training.scene.describe_decode(training.step + 1)
    direct = direct_of(training, rasterize, training.scene)
    gradients = "" if direct is None else "through autograd (--shard)" if run.shard else direct.describe(training.scene, training.step + 1)
    course = find_course(cfg, [capture.views[index].camera for index in capture.train])
    yield Started(training.step, total, training.scene.table.total, training.scene.traits, about, training.computed, gradients, course)
    saved = training.step
    parts: Mapping[str, Tensor] = {}  # terms of the last iteration
    while training.step < total and not exchange.stopping:
        parts = {}  # terms that nobody has read hold on to the last frame
        with training.clock.running():
            done = iterate(training, run, capture, rasterize, exchange)
        step, parts = training.step, done.terms
        if broken := find_broken(training.optimizer, step, cfg.batch):
            check_finite(step, parts)
            raise RunError(explain(f"the parameter '{broken}' or its gradient", step, folder))
        for number, edit in done.edits:
            yield Densified(number, edit)
        if step == total or passes(step, cfg.batch, run.options.log_every):
            check_finite(step, parts)
            if run.group.first:
                yield measure_step(training, done)
        if run.options.preview_every and (step == total or passes(step, cfg.batch, run.options.preview_every)):
            shown = preview(training, run, capture, rasterize, exchange)
            if shown is not None:
                yield shown
        if folder and (step == total or passes(step, cfg.batch, run.options.save_every)):
            check_finite(step, parts)
            exchange.complete()
            tensors = exchange.tensors()
            if writes:
                yield Saved(step, save(training, folder, run.options.keep_checkpoints, tensors))
            del tensors
            saved = step
        del done  # frees its memory before the next frame
        run.watch(training)
    if folder and saved != training.step:
        check_finite(training.step, parts)
        exchange.complete()
        tensors = exchange.tensors()
        if writes:
            yield Saved(training.step, save(training, folder, run.options.keep_checkpoints, tensors))
        del tensors
    if exchange.stopping and training.step < total:
        yield Stopped(training.step, run.stop[0])
    else:
        yield Finished(training.step, training.clock.seconds)


def _begin(cfg: Train, run: Job, capture: Capture, folder: Path | None, rasterize: Rasterizer) -> Training:
    training = begin(cfg, run, capture, folder)
    if run.max_memory > 0:
        fit_memory(training, run.max_memory, capture, lambda *view: see_view(training, run, capture, rasterize, *view))
    return training


def start_exchange(training: Training, run: Job) -> Direct:
    """Return the exchange of a training, and divide or compare the scenes of the processes. Raises
    InputError as `train`."""
    if run.shard:
        check_batch(training.cfg.batch, run.group.size)
        check_shard(training.cfg, run.max_memory, viewer=False)
        exchange: Direct = Sharded(training, run.group, run.stop, run.config.deterministic)
    else:
        exchange = make_exchange(training, run.group, run.stop, run.config.deterministic)
    exchange.start()
    return exchange


def iterate(training: Training, run: Job, capture: Capture, rasterize: Rasterizer, exchange: Direct | None = None) -> Iteration:
    """See the views of one batch and take one optimiser step. Iterations count views, so the step
    advances by `cfg.batch`.

    The order is that of the paper: learning rates; view, decoding, rendering, loss, gradients;
    densification; Adam. exchange: How the gradients and statistics of the views come together; None
    for one process.
    """
    cfg, scene = training.cfg, training.scene
    exchange = exchange or Direct(training, run.group, run.stop)
    training.step += cfg.batch
    begin_rate(training, capture, rasterize)
    training.set_rates()
    scene.begin_iteration(training.step - cfg.batch, training.step, training.companions)
    batch, numbers = training.next_batch(capture.train), training.views_of(training.step)
    mine = range(run.group.rank, cfg.batch, run.group.size)
    upcoming = [batch[place][0] for place in mine] + training.queue[run.group.rank :: run.group.size]
    photographs = resident_of(training, run, capture)
    done = None
    for turn, place in enumerate(mine, 1):
        photographs.prefetch(upcoming[turn : turn + AHEAD])
        done = None  # frees the memory of the previous view
        turn_views = range(place - run.group.rank, place - run.group.rank + run.group.size)
        cameras = [shrink(cfg, numbers[other], capture.views[batch[other][0]].camera)[0] for other in turn_views]
        cameras = [camera.to(run.device, run.dtype) for camera in cameras]
        shown = exchange.scene_of(cameras, numbers[turn_views[0]], Mode.TRAIN, rasterize.visible)
        done = see_view(training, run, capture, rasterize, numbers[place], *batch[place], scene=shown)
        del shown
        exchange.add(done.decoded, done.render, numbers[place])
    assert done is not None
    training.seed_view(training.step + 1)
    exchange.finish()
    rows = exchange.rows() if cfg.sparse_adam or run.shard else None
    rate = training.rate if training.scene.rounding is not None else None
    if rate is not None:
        term, rows = rate.add_gradients(scene, training.step), None
        done = replace(done, terms={**done.terms, "rate": term})
    if any(cfg.growth.reads(number) for number in numbers) or (rate is not None and rate.drops(training.step, cfg.batch)):
        exchange.complete()  # while the statistics have the rows of the table
    limited, before = run.max_memory > 0 and any(cfg.growth.adds(number) for number in numbers), len(scene.table)
    if limited:
        give_back()
    cap = exchange.limit(anchor_cap(scene, cfg.growth.max_anchors, run.max_memory, training.largest), run.max_memory > 0)
    if training.direct is not None and any(cfg.growth.adds(number) for number in numbers):
        training.direct.forget()  # columns and gradients that the edits replace
    edits, survey = [], survey_of(training, run, capture, rasterize)
    for number in numbers:
        cfg.growth.survey(scene, survey, number, training.growth_rng)
        edit = training.growth.update(scene, number, training.growth_rng, cap)
        edits += [] if edit is None else [(number, edit)]
    if limited:
        training.largest.search(before, peak_bytes(scene.table.device))
        give_back()
    exchange.compare(scene.table.total, bool(edits))
    training.optimizer_step(None if edits else rows)
    if rate is not None and rate.drop_closed(scene, training.step, cfg.batch) and training.direct is not None:
        training.direct.forget()
    cfg.growth.finish(scene, training.step, training.rates(), training.growth_rng)
    training.update_averages()
    return replace(done, edits=tuple(edits))


def begin_rate(training: Training, capture: Capture, rasterize: Rasterizer) -> None:
    """Begin the rate of a training with --rate when it is due: every process does the same."""
    rate, scene = training.rate, training.scene
    if rate is None or not rate.is_due(training.step):
        return
    columns, device = {name: scene.table.params[name] for name in ROUNDED}, scene.table.device
    cameras = [camera_of(training, capture, i, device, columns["offsets"].dtype) for i in evenly(capture.train, MOST_VIEWS)]
    background = torch.tensor(capture.background).to(columns["offsets"])
    found = find_sensitivity(scene, columns, training.step, cameras, background, rasterize)
    training.add_groups(rate.begin(scene, found, capture.world.scale))
    if training.direct is not None:
        training.direct.forget()


def see_view(
    training: Training,
    run: Job,
    capture: Capture,
    rasterize: Rasterizer,
    number: int,
    index: int,
    color: Tensor | None,
    scene: Scene | None = None,
) -> Iteration:
    """Draw training view `index` as iteration `number`, and add the gradients of its loss to those
    of the parameters.

    color: Background [3] of this view; None is the background of the capture.  scene: What to draw;
    None is the scene of the training.
    """
    cfg, scene = training.cfg, scene or training.scene
    camera, by = shrink(cfg, number, capture.views[index].camera)
    camera = camera.to(run.device, run.dtype)
    photographs = resident_of(training, run, capture)
    target, mask = photographs.see(index, by)
    training.seed_view(number)
    direct, depth = direct_of(training, rasterize, scene), photographs.depth(index) if cfg.loss.depth else None
    if direct is not None and not direct.refused and depth is None:
        decoded, render, terms = direct.see(scene, camera, number, target, mask, photographs.background(color))
        training.largest.see(decoded, render)
        return Iteration(decoded, render, terms, target, mask)
    pose = None if scene.poses is None else scene.poses.pose_of(camera)
    camera = camera if pose is None else at_pose(camera, pose)
    decoded = scene(camera, number, Mode.TRAIN, rasterize.visible)
    drawn = decoded.gaussians if pose is None else attach(decoded.gaussians, pose)
    render = rasterize(drawn, camera, photographs.background(color))
    render = replace(render, image=scene.as_photographed(render.image, camera))
    parts = compute_terms(Sample(decoded, render, target, mask, number, depth), cfg.loss)
    loss = torch.stack(list(parts.values())).sum()
    if loss.requires_grad:
        loss.backward()
    decoded, render, parts = without_graph((decoded, render, parts))
    training.largest.see(decoded, render)
    return Iteration(decoded, render, parts, target, mask)


def camera_of(training: Training, capture: Capture, index: int, device: torch.device | str, dtype: torch.dtype) -> Camera:
    """Return the camera of a view, of a training view at its refined pose."""
    camera, poses = capture.views[index].camera.to(device, dtype), training.scene.poses
    return camera if poses is None else poses.refine(camera)


def resident_of(training: Training, run: Job, capture: Capture) -> Resident:
    """Return the photographs of the training. Where --max-memory limits it, none are kept on the
    device."""
    known = training.resident
    if known is None or known.capture is not capture or known.dtype != run.dtype:
        known = training.resident = Resident(capture, run.device, run.dtype, 0 if run.max_memory > 0 else None)
    return known


def direct_of(training: Training, rasterize: Rasterizer, scene: Scene) -> DirectStep | None:
    """Return what draws the views of a training on a GPU without autograd, if it does not refuse;
    None on a CPU, and for a scene that several processes share."""
    if scene is not training.scene or scene.table.device.type != "cuda":
        return None
    known = training.direct
    if known is None or known.rasterize is not rasterize:
        known = training.direct = DirectStep(rasterize, training.cfg.loss)
    return known


def survey_of(training: Training, run: Job, capture: Capture, rasterize: Rasterizer) -> Survey:
    """Return the training views as densification can look at them."""

    def photo(index: int) -> TrainingPhoto:
        camera = camera_of(training, capture, index, run.device, run.dtype)
        image, mask = resident_of(training, run, capture).see(index)
        exposures = training.scene.exposures
        return TrainingPhoto(camera, image if exposures is None else exposures.undo(image, camera), mask)

    return Survey(capture.train, photo, rasterize, resident_of(training, run, capture).background(None))


@torch.no_grad()
def preview(training: Training, run: Job, capture: Capture, rasterize: Rasterizer, exchange: Direct | None = None) -> Previewed | None:
    """Render one held-out view, or a training view if none is held out, in process 0. Every process
    must call this."""
    exchange = exchange or Direct(training, run.group, run.stop)
    index = (capture.test or capture.train)[0]
    camera = camera_of(training, capture, index, run.device, run.dtype)
    with training.averaged():
        cameras = [camera, *([None] * (run.group.size - 1))]
        scene = exchange.scene_of(cameras, training.step, Mode.DRAW, rasterize.visible)
        if not run.group.first:
            return None
        decoded = scene(camera, training.step, Mode.DRAW, rasterize.visible)
    picture = rasterize(decoded.gaussians, camera, torch.tensor(capture.background, device=run.device, dtype=run.dtype)).image
    return Previewed(training.step, index, picture.clamp(0, 1).cpu())
