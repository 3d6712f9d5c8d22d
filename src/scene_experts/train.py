"""The training loop: yields events, saves, resumes; knows no method by name."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import time
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from scene_experts import checkpoint
from scene_experts.config import RunConfig, Train, to_json
from scene_experts.data.capture import Capture
from scene_experts.errors import InputError, RunError
from scene_experts.losses import hinge_is_on, load_dense, load_sparse, terms
from scene_experts.render import Rasterizer
from scene_experts.scene.anchors import AnchorScene
from scene_experts.strategy.grow import Edit
from scene_experts.table import Table
from scene_experts.types import Decoded, Render

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Run:
    """Where and how a training runs; nothing here changes its numbers but `stop_at`."""

    config: RunConfig
    out: Path | None = None  # the run folder; None keeps nothing
    device: str = "cpu"
    dtype: torch.dtype = torch.float32  # float64 with the reference rasteriser shows what rounding does; not for real trainings
    resume: bool = False
    save_every: int = 5000  # iterations between checkpoints; the last iteration is always saved
    preview_every: int = 0  # iterations between pictures of one held-out view; 0: none
    log_every: int = 10  # iterations between Stepped events
    max_memory: float = 0.0  # GiB of memory (resident, or reserved on the GPU) at which growth stops; 0: no cap
    keep: int = 2  # checkpoints kept
    stop: list[str] = field(default_factory=list)  # put a reason here (a signal handler does) to save and stop


@dataclass(frozen=True)
class Started:
    step: int  # 0, or where the run resumes
    total: int  # the last iteration of this run
    anchors: int
    voxel: float = 0.0  # edge of the finest lattice cell, trained world units


@dataclass(frozen=True)
class Stepped:
    step: int
    terms: dict[str, float]  # weighted, by name
    psnr: float  # of the training view where its mask counts, dB
    anchors: int
    visible: int  # anchors this view decoded
    gaussians: int  # of them drawn
    active: float  # share of decoded Gaussians with positive opacity
    seconds: float  # of training so far, without saving and previews
    routing: dict[str, list[float]]  # mean share of assignments per expert, by attribute
    balance: dict[str, float] = field(default_factory=dict)  # L_load^S / k, or L_load^D while dense, by attribute: 1 is perfect balance
    entropy: dict[str, float] = field(default_factory=dict)  # of the gates, by attribute: 1 all experts alike, 0 one alone


@dataclass(frozen=True)
class Adjusted:
    step: int
    edit: Edit


@dataclass(frozen=True)
class Previewed:
    step: int
    view: int
    picture: Tensor  # [H, W, 3]


@dataclass(frozen=True)
class Saved:
    step: int
    path: Path


@dataclass(frozen=True)
class Stopped:
    step: int
    reason: str


@dataclass(frozen=True)
class Finished:
    step: int
    seconds: float


Event = Started | Stepped | Adjusted | Previewed | Saved | Stopped | Finished


@dataclass(frozen=True)
class Iteration:
    """What one iteration saw and did."""

    decoded: Decoded
    render: Render
    terms: dict[str, Tensor]
    target: Tensor  # [H, W, 3]
    mask: Tensor | None  # [H, W]
    edit: Edit | None


class Training:
    """Everything that a resumed run must find again: scene, optimiser, random streams, the queue of views, the clock."""

    def __init__(self, cfg: Train, scene: AnchorScene) -> None:
        self.cfg, self.scene = cfg, scene
        self.step = 0
        self.seconds = 0.0
        self.queue: list[int] = []
        self.capture = ""  # its fingerprint
        self.views = torch.Generator().manual_seed(cfg.seed)
        self.growth = torch.Generator().manual_seed(cfg.seed + 1)
        groups = [{"params": params, "name": name, "lr": 0.0} for name, params in scene.rate_groups().items()]
        fused = all(p.device.type in ("cpu", "cuda") and p.dtype == torch.float32 for g in groups for p in g["params"])
        self.optimizer = torch.optim.Adam(groups, lr=0.0, betas=(0.9, 0.999), eps=1e-15, fused=fused)
        scene.table.attach(self.optimizer)

    @classmethod
    def start(cls, cfg: Train, capture: Capture, device: str, dtype: torch.dtype = torch.float32) -> Training:
        """A fresh training of `cfg` (already scaled) on a capture. Raises InputError when the capture has no points or no training view."""
        if capture.points is None:
            raise InputError("expected 3D points in the capture, found none; use --init random, or run structure from motion again")
        if not capture.train:
            raise InputError("expected at least one training view, found none; choose another --split")
        torch.manual_seed(cfg.seed)
        cap, points = cfg.growth.max_anchors, len(capture.points.xyz)
        if cap and cap < points and (n := len(AnchorScene.from_points(cfg.scene, capture.points, capture.extent).table)) > cap:
            raise InputError(f"expected at most {cap:,} anchors to start with, found {n:,}; raise --max-anchors or --scene.voxel-size")
        torch.manual_seed(cfg.seed)
        return cls(cfg, to_device(AnchorScene.from_points(cfg.scene, capture.points, capture.extent), device, dtype))

    def next_view(self, train: tuple[int, ...], ahead: int = 3) -> tuple[int, list[int]]:
        """The next training view and the few after it: each view once per epoch, in random order."""
        while len(self.queue) < ahead + 1:
            self.queue += [train[i] for i in torch.randperm(len(train), generator=self.views).tolist()]
        return self.queue.pop(0), self.queue[:ahead]

    def set_rates(self) -> None:
        for group in self.optimizer.param_groups:
            group["lr"] = self.cfg.rates.at(group["name"], self.step, self.cfg.iterations, self.scene.extent)

    def tensors(self) -> dict[str, Tensor]:
        """The state as named tensors."""
        table = self.scene.table
        out = {f"params.{k}": v.detach() for k, v in table.params.items()}
        out |= {f"facts.{k}": v for k, v in table.facts.items()} | {f"stats.{k}": v for k, v in table.stats.items()}
        out |= {f"network.{k}": v.detach() for k, v in self.scene.network_tensors().items()}
        for group in self.optimizer.param_groups:
            for i, parameter in enumerate(group["params"]):
                for key, value in self.optimizer.state.get(parameter, {}).items():
                    out[f"adam.{group['name']}.{i}.{key}"] = value
        out |= {"rng.torch": torch.get_rng_state(), "rng.views": self.views.get_state(), "rng.growth": self.growth.get_state()}
        if table.facts["xyz"].is_cuda:
            out["rng.cuda"] = torch.cuda.get_rng_state(table.facts["xyz"].device)
        out["queue"] = torch.tensor(self.queue, dtype=torch.int64)
        return out

    def meta(self) -> dict:
        return {
            "recipe": self.cfg.recipe,
            "step": self.step,
            "seconds": self.seconds,
            "voxel": self.scene.voxel,
            "extent": self.scene.extent,
            "config": config_hash(self.cfg),
            "capture": self.capture,
        }

    @classmethod
    def restore(cls, cfg: Train, tensors: dict[str, Tensor], meta: dict, device: str) -> Training:
        """The training that `tensors` and `meta` were taken from. Raises InputError when they are of another configuration."""
        if meta["config"] != config_hash(cfg):
            raise InputError(
                "expected a checkpoint of this configuration, found one trained with other settings; "
                "resume with the run's own flags, or start in another --out folder"
            )
        training = cls(cfg, to_device(scene_from(cfg, tensors, meta), device))
        table = training.scene.table
        table.stats = {k.removeprefix("stats."): v.to(device) for k, v in tensors.items() if k.startswith("stats.")}
        for group in training.optimizer.param_groups:
            for i, parameter in enumerate(group["params"]):
                prefix = f"adam.{group['name']}.{i}."
                state = {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}
                if state:
                    training.optimizer.state[parameter] = {k: v.to(device) for k, v in state.items()}
        torch.set_rng_state(tensors["rng.torch"])
        if "rng.cuda" in tensors and table.facts["xyz"].is_cuda:
            torch.cuda.set_rng_state(tensors["rng.cuda"], table.facts["xyz"].device)
        training.views.set_state(tensors["rng.views"])
        training.growth.set_state(tensors["rng.growth"])
        training.queue = tensors["queue"].tolist()
        training.step, training.seconds, training.capture = int(meta["step"]), float(meta["seconds"]), meta.get("capture", "")
        return training


def scene_from(cfg: Train, tensors: dict[str, Tensor], meta: dict) -> AnchorScene:
    """A scene from a checkpoint's tensors; `cfg` must be scaled."""
    pick = lambda prefix: {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}  # noqa: E731
    scene = AnchorScene(cfg.scene, Table(pick("params."), pick("facts.")), float(meta["voxel"]), float(meta["extent"]))
    stored, wanted = pick("network."), scene.network_tensors()
    if stored.keys() != wanted.keys() or any(stored[k].shape != wanted[k].shape for k in wanted):
        raise InputError("expected the networks of this recipe in the checkpoint, found others; evaluate it with its own run folder")
    with torch.no_grad():
        for name, parameter in wanted.items():
            parameter.copy_(stored[name])
    return scene


def to_device(scene: AnchorScene, device: str, dtype: torch.dtype | None = None) -> AnchorScene:
    """The scene with all its tensors on `device`, and its real ones of `dtype` where one is given."""
    scene = scene.to(device, dtype)
    scene.table.facts = {k: v.to(device, dtype if v.is_floating_point() else None) for k, v in scene.table.facts.items()}
    return scene


def check_finite(event: Stepped) -> None:
    """Raises RunError when the losses are no longer numbers: nothing is saved over the last good checkpoint."""
    bad = [name for name, value in event.terms.items() if not math.isfinite(value)]
    if bad:
        raise RunError(
            f"expected finite losses, found {', '.join(bad)} = {event.terms[bad[0]]} at iteration {event.step}; "
            "the last checkpoint is intact: look at the capture with `scene-experts info`, or lower the learning rates (--rates...)"
        )


def config_hash(cfg: Train) -> str:
    """A short hash of everything in the configuration."""
    return hashlib.sha256(json.dumps(to_json(cfg), sort_keys=True).encode()).hexdigest()[:16]


def train(cfg: Train, run: Run, capture: Capture, rasterize: Rasterizer) -> Iterator[Event]:
    """Train `cfg` (as the user wrote it; windows are scaled here) on a capture, from scratch or from the run's newest whole checkpoint."""
    cfg = cfg.scaled()
    folder = run.out / "checkpoints" if run.out else None
    training = resume(cfg, folder, run.device) if run.resume and folder else None
    if training and training.capture not in ("", capture.fingerprint()):
        raise InputError(f"expected the capture that this run was trained on, found other views in {capture.root}; give the right --data")
    training = training or Training.start(cfg, capture, run.device, run.dtype)
    training.capture = capture.fingerprint()
    total = min(cfg.iterations, run.config.stop_at or cfg.iterations)
    yield Started(training.step, total, len(training.scene.table), training.scene.voxel)
    saved = training.step
    while training.step < total and not run.stop:
        began = time.perf_counter()
        done = iterate(training, run, capture, rasterize)
        training.seconds += time.perf_counter() - began
        step = training.step
        if done.edit is not None:
            yield Adjusted(step, done.edit)
        if step % run.log_every == 0 or step == total:
            seen = stepped(training, done)
            check_finite(seen)
            yield seen
        if run.preview_every and (step % run.preview_every == 0 or step == total):
            yield preview(training, run, capture, rasterize)
        if folder and (step % run.save_every == 0 or step == total):
            yield Saved(step, save(training, folder, run.keep))
            saved = step
    if folder and saved != training.step:
        yield Saved(training.step, save(training, folder, run.keep))
    if run.stop and training.step < total:
        yield Stopped(training.step, run.stop[0])
    else:
        yield Finished(training.step, training.seconds)


def iterate(training: Training, run: Run, capture: Capture, rasterize: Rasterizer) -> Iteration:
    """One iteration, in the paper's order: rates, view, decode, draw, losses, gradients, density control, Adam."""
    cfg, scene = training.cfg, training.scene
    training.step += 1
    training.set_rates()
    index, following = training.next_view(capture.train)
    capture.images.prefetch(following)
    camera = capture.views[index].camera.to(run.device, run.dtype)
    frame = capture.frame(index)
    target = frame.rgb.to(run.device, run.dtype) / 255.0
    mask = None if frame.mask is None else frame.mask.to(run.device, run.dtype)
    background = torch.rand(3, generator=training.views) if cfg.random_background else torch.tensor(capture.background)
    decoded = scene(camera, training.step, True, rasterize.visible)
    if cfg.loss.opacity_scope == "all" and hinge_is_on(cfg.loss, training.step):
        decoded = replace(decoded, scene_opacity=scene.scene_opacity(camera, training.step))
    render = rasterize(decoded.gaussians, camera, background.to(run.device, run.dtype))
    parts = terms(decoded, render, target, cfg.loss, training.step, mask)
    loss = torch.stack(list(parts.values())).sum()
    if loss.requires_grad:
        loss.backward()
    cfg.growth.observe(scene, decoded, render, training.step)
    growth = replace(cfg.growth, max_anchors=anchor_cap(scene, cfg.growth.max_anchors, run.max_memory))
    edit = growth.update(scene, training.step, training.growth)
    training.optimizer.step()
    training.optimizer.zero_grad(set_to_none=True)
    return Iteration(decoded, render, parts, target, mask, edit)


@torch.no_grad()
def stepped(training: Training, done: Iteration) -> Stepped:
    """The figures of the iteration just made."""
    decoded = done.decoded
    weight = torch.ones_like(done.target[..., 0]) if done.mask is None else done.mask
    error = (done.render.image.clamp(0, 1) - done.target).square().mean(2)
    mse = float((error * weight).sum() / weight.sum().clamp_min(1e-12))
    raw = decoded.raw_opacity
    shares, balance, entropy = {}, {}, {}
    for attribute, r in decoded.routing.items():
        A, E = r.gates.shape
        if r.chosen is None:
            share, value = r.gates.sum(0) / max(A, 1), load_dense(r.gates)
        else:
            k = r.chosen.shape[1]
            share, value = torch.bincount(r.chosen.reshape(-1), minlength=E) / max(A * k, 1), load_sparse(r.gates, r.chosen) / k
        balance[attribute] = float(value)
        entropy[attribute] = float(torch.special.entr(r.gates).sum()) / max(A, 1) / math.log(E)
        shares[attribute] = [round(float(c), 4) for c in share]
    return Stepped(
        step=training.step,
        terms={k: float(v) for k, v in done.terms.items()},
        psnr=-10.0 * math.log10(max(mse, 1e-10)),
        anchors=len(training.scene.table),
        visible=len(decoded.rows),
        gaussians=len(decoded.gaussians),
        active=float((raw > 0).float().mean()) if raw is not None and raw.numel() else 0.0,
        seconds=training.seconds,
        routing=shares,
        balance=balance,
        entropy=entropy,
    )


@torch.no_grad()
def preview(training: Training, run: Run, capture: Capture, rasterize: Rasterizer) -> Previewed:
    """A picture of one held-out view (a training view where none is held out)."""
    index = (capture.test or capture.train)[0]
    camera = capture.views[index].camera.to(run.device, run.dtype)
    decoded = training.scene(camera, training.step, False, rasterize.visible)
    picture = rasterize(decoded.gaussians, camera, torch.tensor(capture.background, device=run.device, dtype=run.dtype)).image
    return Previewed(training.step, index, picture.clamp(0, 1).cpu())


def save(training: Training, folder: Path, keep: int) -> Path:
    """Write a checkpoint, whole or not at all."""
    tensors = {k: v.detach().cpu().contiguous() for k, v in training.tensors().items()}
    return checkpoint.save(folder, training.step, tensors, training.meta(), keep=keep)


def resume(cfg: Train, folder: Path, device: str) -> Training | None:
    """The newest whole checkpoint of a run, or None where there is none yet. Raises InputError where all that there are are damaged."""
    path = checkpoint.latest(folder)
    if path is None and any(folder.glob("ckpt_*.safetensors")):
        raise InputError(f"expected a whole checkpoint in {folder}, found only damaged ones; copy one back, or begin anew with --overwrite")
    if path is None:
        return None
    tensors, meta = checkpoint.load(path)
    checkpoint.expect(meta, recipe=cfg.recipe)
    return Training.restore(cfg, tensors, meta, device)


def anchor_cap(scene: AnchorScene, cap: int, max_memory: float) -> int:
    """The cap on anchors now: the user's own, and what still fits below `max_memory` GiB (0: no cap); see `used_bytes`."""
    if max_memory <= 0:
        return cap
    n = len(scene.table)
    columns = scene.table.columns().values()
    per_anchor = sum(v.element_size() * v[0].numel() * (4 if v.requires_grad else 1) for v in columns) + 4 * (2 + 2 * scene.K)
    left = max_memory * 2**30 - used_bytes(scene.table.facts["xyz"].device)
    room = max(0, int(left / (2 * per_anchor)))  # twice: a row edit holds old and new columns at once
    return min(n + room, cap) if cap else max(n + room, 1)


def used_bytes(device: torch.device) -> int:
    """Memory that this process holds, bytes: of the GPU for a CUDA device, else resident; 0 where the system does not tell."""
    if device.type == "cuda":
        return torch.cuda.memory_reserved(device)
    try:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0
