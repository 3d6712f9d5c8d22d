"""Train recipes on a shipped capture with tensors that pretend to be on CUDA, and print what they did as JSON.

    python -m support.pretend.train moe-gs:fused scaffold-gs:composed        # in tests/, with the guard loaded

Each training grows, is saved and restored, draws a preview, is scored, baked and painted. An operation on tensors of two devices ends it.
"""

import sys
import tempfile
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import _disable_current_modes

from scene_experts.core.types import Camera, Mode
from scene_experts.data.capture import Capture
from scene_experts.evaluate import score
from scene_experts.evaluate.options import EvalOptions
from scene_experts.files.bake.bake import Bake, bake
from scene_experts.files.bake.refine import Refine
from scene_experts.render import Rasterizer
from scene_experts.render.gsplat import GsplatRasterizer
from scene_experts.scene import Scene
from scene_experts.training import loop
from scene_experts.training.measure import measure_step
from scene_experts.training.run_folder import OpenRun
from scene_experts.training.state import Training
from scene_experts.view.paint import paint
from support.pretend.setup import answer, load_small, run_of, short
from support.pretend.tensors import CUDA, counts

STEPS = 10


def draw_frozen(scene: Scene, camera: Camera, step: int, draw: Rasterizer) -> dict[str, Any] | None:
    """Whether a frozen scene decodes the same bits, and the kernels of both decodes. None if the scene cannot be frozen."""
    frozen = scene.frozen(step)
    if frozen is scene:
        return None
    results, kernels = [], []
    with torch.no_grad():
        for decode in (scene, frozen):
            counts.reset()
            results.append(vars(decode(camera, step, Mode.DRAW, draw.visible).gaussians))
            kernels.append(sum(counts.kernels.values()))
    equal = all(torch.equal(t.cpu(), results[1][name].cpu()) for name, t in results[0].items())
    return {"equal": equal, "kernels": kernels}


def try_recipe(capture: Capture, word: str) -> dict[str, Any]:
    """Train, and do everything that is done with a training. Returns counts of the last step that is not near a densification."""
    recipe, _, decode = word.partition(":")
    cfg = short(recipe)
    if decode == "composed" and hasattr(cfg.scene, "decode"):
        cfg = replace(cfg, scene=replace(cfg.scene, decode="composed"))
    if decode == "sparse":
        cfg = replace(cfg, sparse_adam=True)
    run, draw = run_of(cfg, "cuda"), GsplatRasterizer(antialias=cfg.antialias)
    draw = loop.for_training(draw, cfg.growth.absolute)
    found: dict[str, Any] = {"edits": 0}
    edited = False
    training = Training.start(cfg, capture, "cuda")
    training.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    for _ in range(STEPS):
        counts.reset()
        done = loop.iterate(training, run, capture, draw)
        if done.edits:
            found["edits"] += 1
        if done.edits or edited:  # a graph is built anew in the step after
            edited = bool(done.edits)
            continue
        found["kernels"], found["waits"], found["blocking"] = sum(counts.kernels.values()), dict(counts.waits), dict(counts.blocking)
        found["bytes"], found["moved"], found["where"] = counts.bytes, counts.moved.most_common(40), counts.where.most_common(40)
        found["names"] = counts.kernels.most_common(25)
        found["sizes"] = [len(training.scene.table), len(done.decoded.rows), len(done.decoded.gaussians)]
    measure_step(training, done)
    loop.preview(training, run, capture, draw)
    saved = {name: t.detach().cpu().contiguous() for name, t in training.tensors().items()}
    again = Training.restore(cfg, saved, training.meta(), "cuda")
    again.scene.set_training_cameras([capture.views[i].camera for i in capture.train])
    loop.iterate(again, run, capture, draw)
    scene, camera = again.scene, capture.views[capture.test[0]].camera.to("cuda")
    found["frozen"] = draw_frozen(scene, camera, again.step, draw)
    paint(scene, camera, again.step, draw, torch.zeros(3, device=CUDA))
    with tempfile.TemporaryDirectory() as folder:
        score.evaluate(scene, capture, draw, Path(folder), EvalOptions(lpips=False), step=again.step)
    with tempfile.TemporaryDirectory() as folder, _disable_current_modes():
        restored = Training.restore(cfg, saved, training.meta(), "cpu").scene  # `export` bakes on the CPU
        opened = OpenRun(Path(folder), run.config, restored, training.step, training.clock)
        how = Bake(sh_degree=1, refine=Refine(iterations=3))
        found["baked"] = len(bake(opened, capture, how, None, lambda *words: None).scene.table)
    return found


if __name__ == "__main__":
    raise SystemExit(answer(sys.argv[1:], partial(try_recipe, load_small())))
