"""The training loop. It yields events, saves checkpoints and resumes runs. It does not depend on any method."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from scene_experts.core.errors import InputError, RunError
from scene_experts.core.transfer import upload
from scene_experts.core.types import Decoded, Mode, Render, Routing
from scene_experts.data.capture import Capture
from scene_experts.render import Rasterizer, for_growth
from scene_experts.strategy import Edit
from scene_experts.strategy.survey import Photo, Survey
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.events import Densified, Event, Finished, Previewed, Saved, Started, Stepped, Stopped
from scene_experts.training.guard import explain, find_broken
from scene_experts.training.losses import Sample, compute_terms, load_dense, load_sparse
from scene_experts.training.memory import anchor_cap, check_start
from scene_experts.training.state import Training, resume, save

log: logging.Logger = logging.getLogger(__name__)
ROUTED = 16_384  # anchors sampled for the routing statistics; the shares are within 0.5 % of those of all anchors


@dataclass(frozen=True)
class Run:
    """Options of a training run that do not affect its results, except for `stop_at`."""

    config: RunConfig
    out: Path | None = None  # the run folder; None writes no files
    device: str = "cpu"
    dtype: torch.dtype = torch.float32  # float64 is for tests of rounding errors with the reference rasteriser
    resume: bool = False
    save_every: int = 5000  # iterations between checkpoints; the last iteration is always saved
    preview_every: int = 0  # iterations between previews of one held-out view; 0: none
    log_every: int = 10  # iterations between Stepped events
    max_memory: float = 0.0  # GiB of memory (resident, or reserved on the GPU) at which densification stops; 0: no limit
    keep: int = 2  # number of checkpoints to keep
    begin: Callable[[Training], None] = lambda training: None  # called once, before the first event
    watch: Callable[[Training], None] = lambda training: None  # called between iterations and not timed; the viewer renders here
    stop: list[str] = field(default_factory=list)  # append a reason to save and stop, for example from a signal handler


@dataclass(frozen=True)
class Iteration:
    """Inputs and results of one iteration."""

    decoded: Decoded
    render: Render
    terms: dict[str, Tensor]
    target: Tensor  # [H, W, 3]
    mask: Tensor | None  # [H, W]
    edit: Edit | None


def train(cfg: Train, run: Run, capture: Capture, rasterize: Rasterizer) -> Iterator[Event]:
    """Train a scene on a capture, from scratch or from the newest valid checkpoint of the run.

    Args:
        cfg: The settings before scaling. This function scales the schedule.
        run: Options of the run.
        capture: The views and points to train on.
        rasterize: The rasteriser.

    Yields:
        The events of the training. The first is `Started`; the last is `Finished` or `Stopped`.

    Raises:
        InputError: The settings, the capture or the checkpoint cannot be used.
        RunError: A loss or a parameter is not finite, or a checkpoint cannot be written.
    """
    cfg = cfg.scaled()
    folder = run.out / "checkpoints" if run.out else None
    training = resume(cfg, folder, run.device) if run.resume and folder else None
    if training and training.capture_id not in ("", capture.fingerprint()):
        raise InputError(f"expected the capture that this run was trained on, found other views in {capture.root}; give the right --data")
    training = training or Training.start(cfg, capture, run.device, run.dtype)
    check_start(training.scene, training.step > 0, run.max_memory)
    training.capture_id = capture.fingerprint()
    training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    rasterize = for_growth(rasterize, cfg.growth.absolute)
    total = min(cfg.iterations, run.config.stop_at or cfg.iterations)
    run.begin(training)
    yield Started(training.step, total, len(training.scene.table), training.scene.traits)
    saved, parts = training.step, {}
    while training.step < total and not run.stop:
        with training.clock.running():
            done = iterate(training, run, capture, rasterize)
        step, parts = training.step, done.terms
        if broken := find_broken(training.optimizer, step):
            check_finite(step, parts)
            raise RunError(explain(f"the parameter '{broken}' or its gradient", step, folder))
        if done.edit is not None:
            yield Densified(step, done.edit)
        if step % run.log_every == 0 or step == total:
            check_finite(step, parts)
            yield measure_step(training, done)
        if run.preview_every and (step % run.preview_every == 0 or step == total):
            yield preview(training, run, capture, rasterize)
        if folder and (step % run.save_every == 0 or step == total):
            check_finite(step, parts)
            yield Saved(step, save(training, folder, run.keep))
            saved = step
        del done  # frees its memory before the next frame
        run.watch(training)
    if folder and saved != training.step:
        check_finite(training.step, parts)
        yield Saved(training.step, save(training, folder, run.keep))
    if run.stop and training.step < total:
        yield Stopped(training.step, run.stop[0])
    else:
        yield Finished(training.step, training.clock.seconds)


def iterate(training: Training, run: Run, capture: Capture, rasterize: Rasterizer) -> Iteration:
    """Run one iteration, in the order of the paper: learning rates, view, decoding, rendering, loss, gradients, densification, Adam."""
    cfg, scene = training.cfg, training.scene
    training.step += 1
    training.set_rates()
    index, following = training.next_view(capture.train)
    camera = capture.views[index].camera.to(run.device, run.dtype)
    frame = capture.frame(index)
    capture.images.prefetch(following)
    target = upload(frame.rgb, run.device, run.dtype).div_(255.0)
    mask = None if frame.mask is None else upload(frame.mask, run.device, run.dtype)
    background = torch.rand(3, generator=training.views_rng) if cfg.random_background else torch.tensor(capture.background)
    decoded = scene(camera, training.step, Mode.TRAIN, rasterize.visible)
    if cfg.loss.needs_scene_opacity(training.step):
        decoded = replace(decoded, scene_opacity=scene.scene_opacity(camera, training.step, Mode.TRAIN))
    render = rasterize(decoded.gaussians, camera, upload(background, run.device, run.dtype))
    parts = compute_terms(Sample(decoded, render, target, mask, training.step), cfg.loss)
    loss = torch.stack(list(parts.values())).sum()
    if loss.requires_grad:
        loss.backward()
    decoded, render, parts = without_graph((decoded, render, parts))
    del loss
    training.largest.see(decoded, render)
    cap = anchor_cap(scene, cfg.growth.max_anchors, run.max_memory, training.largest)
    cfg.growth.observe(scene, decoded, render, training.step)
    cfg.growth.survey(scene, survey_of(training, run, capture, rasterize), training.step, training.growth_rng)
    edit = cfg.growth.update(scene, training.step, training.growth_rng, cap)
    step_optimizer(training, decoded, edit)
    cfg.growth.finish(scene, training.step, training.rates(), training.growth_rng)
    training.update_averages()
    return Iteration(decoded, render, parts, target, mask, edit)


def survey_of(training: Training, run: Run, capture: Capture, rasterize: Rasterizer) -> Survey:
    """Return the training views as densification can look at them."""

    def photo(index: int) -> Photo:
        frame = capture.frame(index)
        mask = None if frame.mask is None else upload(frame.mask, run.device, run.dtype)
        image = upload(frame.rgb, run.device, run.dtype).div_(255.0)
        return Photo(capture.views[index].camera.to(run.device, run.dtype), image, mask)

    return Survey(capture.train, photo, rasterize, torch.tensor(capture.background))


def step_optimizer(training: Training, decoded: Decoded, edit: Edit | None) -> None:
    """Run one optimiser step.

    With `sparse_adam`, only the decoded rows are updated. All rows are updated if densification added or removed rows, or if the loss
    has a gradient for rows that were not decoded.
    """
    cfg = training.cfg
    if cfg.sparse_adam and edit is None and not cfg.loss.reaches_every_row(decoded):
        training.optimizer.step(rows=decoded.rows)  # type: ignore[call-arg]
    else:
        training.optimizer.step()
    training.optimizer.zero_grad(set_to_none=True)


def without_graph(value: Any) -> Any:
    """Return the same value with every tensor detached, so that the buffers of the autograd graph can be freed."""
    if isinstance(value, Tensor):
        return value.detach()
    if isinstance(value, (tuple, list)):
        return type(value)(without_graph(item) for item in value)
    if isinstance(value, dict):
        return {name: without_graph(item) for name, item in value.items()}
    if is_dataclass(value) and not isinstance(value, type):
        return replace(value, **{f.name: without_graph(getattr(value, f.name)) for f in fields(value) if f.init})
    return value


def check_finite(step: int, parts: dict[str, Tensor]) -> None:
    """Check the losses before saving. Raises RunError if one is not finite, so that the last valid checkpoint is kept."""
    bad = [name for name, value in parts.items() if not math.isfinite(value)]
    if bad:
        raise RunError(
            f"expected finite losses, found {', '.join(bad)} = {float(parts[bad[0]])} at iteration {step}; "
            "the last checkpoint is intact: look at the capture with `scene-experts info`, or lower the learning rates (--rates...)"
        )


@torch.no_grad()
def measure_step(training: Training, done: Iteration) -> Stepped:
    """Compute the statistics of the last iteration."""
    decoded = done.decoded
    error = done.render.image.clamp(0, 1).sub_(done.target).square_()
    mse = float(error.mean() if done.mask is None else (error.mean(2) * done.mask).sum() / done.mask.sum().clamp_min(1e-12))
    raw = decoded.raw_opacity
    balance, entropy = {}, {}
    for attribute, r in decoded.routing.items():
        A, E = r.gates.shape
        balance[attribute] = float(load_dense(r.gates) if r.chosen is None else load_sparse(r.gates, r.chosen) / r.chosen.shape[1])
        entropy[attribute] = float(torch.special.entr(r.gates).sum()) / max(A, 1) / math.log(E)
    scene = training.scene.routing(training.step, ROUTED) if decoded.routing else {}
    return Stepped(
        step=training.step,
        terms={k: float(v) for k, v in done.terms.items()},
        psnr=-10.0 * math.log10(max(mse, 1e-10)),
        anchors=len(training.scene.table),
        visible=len(decoded.rows),
        gaussians=len(decoded.gaussians),
        active=float((raw > 0).float().mean()) if raw is not None and raw.numel() else 0.0,
        seconds=training.clock.seconds,
        routing={attribute: use(r) for attribute, r in decoded.routing.items()},
        balance=balance,
        entropy=entropy,
        scene_routing={attribute: use(r) for attribute, r in scene.items()},
        scene_gates={attribute: use(Routing(r.gates, None)) for attribute, r in scene.items()},
    )


def use(r: Routing) -> list[float]:
    """Return each expert's share of the assignments, or its mean gate while routing is dense, [E]."""
    A, E = r.gates.shape
    share = r.gates.sum(0) / max(A, 1) if r.chosen is None else torch.bincount(r.chosen.reshape(-1), minlength=E) / max(r.chosen.numel(), 1)
    return [round(float(c), 4) for c in share]


@torch.no_grad()
def preview(training: Training, run: Run, capture: Capture, rasterize: Rasterizer) -> Previewed:
    """Render one held-out view, or a training view if none is held out."""
    index = (capture.test or capture.train)[0]
    camera = capture.views[index].camera.to(run.device, run.dtype)
    with training.averaged():
        decoded = training.scene(camera, training.step, Mode.DRAW, rasterize.visible)
    picture = rasterize(decoded.gaussians, camera, torch.tensor(capture.background, device=run.device, dtype=run.dtype)).image
    return Previewed(training.step, index, picture.clamp(0, 1).cpu())
