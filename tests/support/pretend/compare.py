"""Compare training on pretended CUDA with training on the CPU, and print the relative differences of ten steps as JSON.

    python -m support.pretend.compare octree-gs moe-gs:alone sags:unchanged  # in tests/, with the guard loaded

RECIPE: each step starts on both from the same checkpoint, that of the CPU. `losses` and `gradients` are the differences. `close` is how
near the nearest alpha of the picture lies to 1/255, relative, in float64. Below that threshold a Gaussian is skipped: where an alpha lies
nearer to it than float32 can tell, rounding decides whether a pixel has a Gaussian, and one gradient differs. `errors` is the smallest
difference of a colour from the photograph. The L1 loss has a kink at 0: where a colour equals the photograph up to rounding, rounding
decides the sign of its gradient.
RECIPE:alone: both train on their own. Then `gradients` is empty.
RECIPE:unchanged: as RECIPE, and the training starts as it is, without the change that follows.
RECIPE:rate: as RECIPE, with --rate from the first step on, on both.

A training as it starts has equal depths (`start_changed` says why), so the parameters are changed a little before the first step.
Densification is off: it draws random numbers on the device of the scene.
"""

import os
import sys
from dataclasses import replace
from functools import partial

import torch

from scene_experts.core.types import Camera, Gaussians, Render
from scene_experts.data.capture import Capture
from scene_experts.render import Rasterizer, reference
from scene_experts.render.cpu import CpuRasterizer
from scene_experts.render.gsplat import GsplatRasterizer
from scene_experts.training import loop, rate
from scene_experts.training.config import Train
from scene_experts.training.state import Training
from support.pretend.setup import answer, load_small, run_of, short
from support.trainings import CHANGE, start_changed

TEN = 10
TINY = 1e-2


class Steps:
    """A training that takes one step at a time and keeps its gradients. `moves`: whether the optimiser moves the parameters."""

    def __init__(self, training: Training, capture: Capture, device: str, draw: Rasterizer, moves: bool = True) -> None:
        self.capture, self.training, self.run = capture, training, run_of(training.cfg, device)
        self.draw = loop.for_training(draw, training.cfg.growth.absolute)
        self.gradients: list[torch.Tensor] = []
        training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
        step = training.optimizer_step

        def keep(rows: torch.Tensor | None = None) -> None:
            parameters = [p for group in training.scene.rate_groups().values() for p in group]
            self.gradients = [p.grad.cpu().double() for p in parameters if p.grad is not None]
            if moves:
                step(rows)

        training.optimizer_step = keep

    def take(self) -> float:
        """Take a step and return its loss. Keeps the smallest difference of a colour from the photograph."""
        done = loop.iterate(self.training, self.run, self.capture, self.draw)
        self.error = float((done.render.image - done.target).abs().min().cpu())
        return float(sum(float(t.detach().cpu()) for t in done.terms.values()))

    def copy(self, device: str, draw: Rasterizer) -> "Steps":
        """Restore the saved state of this training, for one step without Adam."""
        training = Training.restore(self.training.cfg, self.saved, self.meta, device)
        return Steps(training, self.capture, device, draw, moves=False)

    def save(self) -> None:
        self.saved = {name: t.detach().clone() for name, t in self.training.tensors().items()}
        self.meta = self.training.meta()


def measure(one: list[torch.Tensor], other: list[torch.Tensor]) -> float:
    """The largest difference of two lists of gradients, relative to the norm of each gradient.

    A gradient that is tiny beside the largest one may be nothing but rounding, as that of the rotations of round Gaussians.
    """
    if len(one) != len(other):
        raise ValueError(f"expected as many gradients, found {len(one)} and {len(other)}")
    least = TINY * max(float(b.norm()) for b in other)
    return max(float((a - b).norm()) / max(float(b.norm()), least) for a, b in zip(one, other))


class Watched(CpuRasterizer):
    """The rasteriser of the CPU, which keeps how near the alphas of its last picture lie to the threshold."""

    close = 1.0

    def __call__(self, g: Gaussians, camera: Camera, background: torch.Tensor) -> Render:
        type(self).close = measure_nearest(g, camera)
        return super().__call__(g, camera, background)


@torch.no_grad()
def measure_nearest(g: Gaussians, camera: Camera) -> float:
    """The smallest relative distance of an alpha of the picture to 1/255, in float64."""
    p = reference.project(g.means.double(), g.quats.double(), g.scales.double(), camera)
    row, column = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
    dx, dy = column.double() - p.mean2d[:, 0, None, None], row.double() - p.mean2d[:, 1, None, None]
    a, b, c = (side[:, None, None] for side in p.conic.unbind(1))
    alpha = g.opacities.double()[:, None, None] * (-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy).exp()
    return float((alpha[p.radii > 0] / reference.MIN_ALPHA - 1).abs().min())


def compare(capture: Capture, word: str) -> dict[str, list[float]]:
    recipe, _, how = word.partition(":")
    cfg = short(recipe)
    cfg: Train = replace(cfg, growth=replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=10**6)))
    if how == "rate":
        cfg, rate.first_iteration = replace(cfg, rate=0.01), lambda growth, iterations: 0
    on_cuda, on_cpu = GsplatRasterizer(antialias=cfg.antialias), Watched(antialias=cfg.antialias)
    plain = Steps(start_changed(cfg, capture, change=0.0 if how == "unchanged" else CHANGE), capture, "cpu", on_cpu)
    found: dict[str, list[float]] = {"losses": [], "gradients": [], "close": [], "errors": []}
    if how == "alone":
        alone = Steps(start_changed(cfg, capture, "cuda"), capture, "cuda", on_cuda)
        found["losses"] = [abs(alone.take() / plain.take() - 1) for _ in range(TEN)]
        return found
    for _ in range(TEN):
        plain.save()
        same, loss = plain.copy("cuda", on_cuda), plain.take()
        state = torch.get_rng_state()
        found["losses"].append(abs(same.take() / loss - 1))
        found["gradients"].append(measure(same.gradients, plain.gradients))
        found["close"].append(Watched.close)
        found["errors"].append(plain.error)
        torch.set_rng_state(state)
    return found


if __name__ == "__main__":
    code = answer(sys.argv[1:], partial(compare, load_small()))
    sys.stdout.flush()
    os._exit(code)  # torch's threads sometimes abort the end of the interpreter ("terminate called without an active exception")
