"""Train recipes on a shipped capture with tensors that pretend to be on CUDA, and print what they did as JSON.

    python -m support.pretend.train moe-gs:fused scaffold-gs:composed        # in tests/, with the guard loaded

Each training grows, is saved and restored, draws a preview, is scored, baked and painted. An operation on tensors of two devices ends it.
"""

import json
import sys
import tempfile
import traceback
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch.utils._python_dispatch import _disable_current_modes

import support.pretend.gsplat_stand_in  # noqa: F401  after `tensors`, before gsplat is imported
from scene_experts.core import random
from scene_experts.core.types import Points
from scene_experts.data.capture import Capture, load
from scene_experts.data.settings import Data
from scene_experts.evaluate import score
from scene_experts.evaluate.options import EvalOptions
from scene_experts.files.bake.bake import Bake, bake
from scene_experts.files.bake.refine import Refine
from scene_experts.native import triton
from scene_experts.recipes import RECIPES
from scene_experts.render import gsplat
from scene_experts.render.gsplat import GsplatRasterizer
from scene_experts.render.reference import ReferenceRasterizer
from scene_experts.training import loop
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.optim import FusedAdam
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.state import Training
from scene_experts.view.paint import paint
from support.places import DEMO
from support.pretend.tensors import CUDA, Pretender, Pretending, counts

STEPS, TEN = 9, 10


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **sizes: Any) -> None:
    """Run a Triton kernel in the interpreter, as one kernel. Raises RuntimeError for a tensor on the CPU."""
    tensors = [a for a in arguments if isinstance(a, torch.Tensor)]
    if not all(isinstance(t, Pretender) and t.inner.is_contiguous() for t in tensors):
        raise RuntimeError(f"expected contiguous tensors on CUDA for the kernel {kernel.__name__}, found others")
    counts.kernel(f"triton {kernel.__name__}", sum(t.numel() * t.element_size() for t in tensors))
    with _disable_current_modes():
        kernel[grid](*(a.inner if isinstance(a, Pretender) else a for a in arguments), **sizes)


def count_adam(calls: list[tuple]) -> None:
    """The kernel of Adam reads and writes tensors that it knows by address: value and moments twice, the gradient once."""
    for parameter, rows, *_ in calls:
        values = parameter.numel() if rows is None else len(rows) * parameter[:1].numel()
        counts.bytes += 7 * 4 * values


def short(recipe: str, **changes: Any) -> Train:
    """A recipe on a schedule whose densification runs every 4 iterations and whose experts become sparse after 3."""
    cfg = replace(RECIPES[recipe][1], iterations=40, **changes)
    return replace(cfg, growth=replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=4))).scaled()


def run_of(cfg: Train, device: str) -> loop.Run:
    return loop.Run(RunConfig(cfg, Data(Path("nowhere"))), device=device, log_every=10**9)


def try_recipe(recipe: str, decode: str, capture: Capture) -> dict[str, Any]:
    """Train, and do everything that is done with a training. Returns counts of the last step without densification."""
    cfg = short(recipe)
    if decode == "composed" and hasattr(cfg.scene, "decode"):
        cfg = replace(cfg, scene=replace(cfg.scene, decode="composed"))
    if decode == "sparse":
        cfg = replace(cfg, sparse_adam=True)
    run, draw = run_of(cfg, "cuda"), GsplatRasterizer(antialias=cfg.antialias)
    draw = loop.for_growth(draw, cfg.growth.absolute)
    found: dict[str, Any] = {"edits": 0}
    training = Training.start(cfg, capture, "cuda")
    training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    for _ in range(STEPS):
        counts.reset()
        done = loop.iterate(training, run, capture, draw)
        if done.edits:
            found["edits"] += 1
            continue
        found["kernels"], found["waits"], found["blocking"] = sum(counts.kernels.values()), dict(counts.waits), dict(counts.blocking)
        found["bytes"], found["where"] = counts.bytes, counts.where.most_common(40)
        found["names"] = counts.kernels.most_common(25)
        found["sizes"] = [len(training.scene.table), len(done.decoded.rows), len(done.decoded.gaussians)]
    loop.measure_step(training, done)
    loop.preview(training, run, capture, draw)
    saved = {name: t.detach().cpu().contiguous() for name, t in training.tensors().items()}
    again = Training.restore(cfg, saved, training.meta(), "cuda")
    again.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    loop.iterate(again, run, capture, draw)
    scene, camera = again.scene, capture.views[capture.test[0]].camera.to("cuda")
    paint(scene, camera, again.step, draw, torch.zeros(3, device=CUDA))
    with tempfile.TemporaryDirectory() as folder:
        score.evaluate(scene, capture, draw, Path(folder), EvalOptions(lpips=False), step=again.step)
        restored = Training.restore(cfg, saved, training.meta(), "cpu").scene  # `export` bakes on the CPU
        opened = OpenRun(Path(folder), run.config, restored, training.step, training.clock)
        how = Bake(sh_degree=1, refine=Refine(iterations=3))
        found["baked"] = len(bake(opened, capture, how, None, lambda *words: None).scene.table)
    return found


def compare(recipe: str, capture: Capture) -> dict[str, Any]:
    """Ten steps on pretended CUDA and with the reference on the CPU: the losses of each step.

    Densification is off: it draws random numbers on the device of the scene.
    """
    cfg, losses = short(recipe), []
    cfg = replace(cfg, growth=replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=10**6)))
    for device, draw in (("cuda", GsplatRasterizer(antialias=cfg.antialias)), ("cpu", ReferenceRasterizer(antialias=cfg.antialias))):
        training, run = Training.start(cfg, capture, device), run_of(cfg, device)
        training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
        rasterize = loop.for_growth(draw, cfg.growth.absolute)
        steps = [loop.iterate(training, run, capture, rasterize).terms for _ in range(TEN)]
        losses.append([float(sum(float(t.detach().cpu()) for t in terms.values())) for terms in steps])
    return {"cuda": losses[0], "cpu": losses[1]}


def main(words: list[str]) -> int:
    gsplat.explain_missing = lambda: None
    random.torch = SimpleNamespace(randint=torch.randint, Generator=lambda device: torch.Generator())
    triton.launch = launch
    launch_adam = FusedAdam._launch
    FusedAdam._launch = lambda self, calls: (count_adam(calls), launch_adam(self, calls))[1]
    triton.explain_missing = lambda: None
    score.measure_speed = partial(score.measure_speed, budget=0.0)  # the fewest frames
    capture = load(DEMO / "buddha", resolution="longest:32", max_views=6)
    assert capture.points is not None
    capture = replace(capture, points=Points(capture.points.xyz[::1000], capture.points.rgb[::1000]))
    out: dict[str, Any] = {}
    with Pretending():
        for word in words:
            recipe, _, how = word.partition(":")
            try:
                out[word] = compare(recipe, capture) if how == "compare" else try_recipe(recipe, how, capture)
            except Exception as error:
                traceback.print_exc()
                out[word] = {"error": f"{type(error).__name__}: {str(error)[:500]}"}
    capture.images.close()
    print(json.dumps(out))
    return 0


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
