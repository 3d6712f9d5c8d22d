"""What the programs of this folder share: the small capture, short schedules, and a package that finds CUDA, gsplat and Triton."""

import json
import traceback
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch.utils._python_dispatch import _disable_current_modes

import support.pretend.gsplat_stand_in  # noqa: F401  before gsplat is imported
from scene_experts.core import random
from scene_experts.core.types import Points
from scene_experts.data.capture import Capture
from scene_experts.data.settings import Data
from scene_experts.evaluate import score, timing
from scene_experts.native import triton
from scene_experts.render import gsplat, gsplat_install
from scene_experts.training import loop, photometric
from scene_experts.training.config import RunConfig, Train
from scene_experts.training.optim import FusedAdam
from scene_experts.training.options import TrainOptions
from scene_experts.training.recipes import RECIPES
from support.captures import load
from support.places import DEMO
from support.pretend.tensors import Pretender, Pretending, counts


def launch(kernel: Any, grid: tuple[int, ...], *arguments: Any, **sizes: Any) -> None:
    """Run a Triton kernel in the interpreter, as one kernel. Raises RuntimeError for a tensor on the CPU."""
    tensors = [a for a in arguments if isinstance(a, torch.Tensor)]
    if not all(isinstance(t, Pretender) and t.inner.is_contiguous() for t in tensors):
        raise RuntimeError(f"expected contiguous tensors on CUDA for the kernel {kernel.__name__}, found others")
    counts.kernel(f"triton {kernel.__name__}", sum(t.numel() * t.element_size() for t in tensors))
    with _disable_current_modes():
        kernel[grid](*(a.inner if isinstance(a, Pretender) else a for a in arguments), **sizes)


def count_adam(table: Any) -> None:
    """The kernel of Adam reads and writes tensors that it knows by address: value and moments twice, the gradient once."""
    counts.moved["triton adam"] += 7 * 4 * int(table.values[:, 5].sum())


def short(recipe: str, **changes: Any) -> Train:
    """A recipe on a schedule whose densification runs every 4 iterations and whose experts become sparse after 3."""
    cfg = replace(RECIPES[recipe][1], iterations=40, **changes)
    return replace(cfg, growth=replace(cfg.growth, adjust=replace(cfg.growth.adjust, interval=4))).scaled()


def run_of(cfg: Train, device: str) -> loop.Job:
    return loop.Job(RunConfig(cfg, Data(Path("nowhere"))), device=device, options=TrainOptions(log_every=10**9, preview_every=0))


def prepare() -> None:
    """Change the package so that it finds gsplat and Triton, and counts their kernels."""
    gsplat.explain_missing = gsplat_install.explain_missing = lambda: None
    photometric.TILE = 64  # the interpreter takes as long for a program of any size
    random.torch = SimpleNamespace(randint=torch.randint, Generator=lambda device: torch.Generator())
    triton.launch = launch
    triton.Launch.__call__ = lambda self, grid, *arguments: launch(self.kernel, grid, *arguments, **self.sizes)
    launch_adam = FusedAdam._launch_table
    FusedAdam._launch_table = lambda self, table: (count_adam(table), launch_adam(self, table))[1]
    triton.explain_missing = lambda: None
    timing.WARM_UP = 1
    timing.measure_speed = score.measure_speed = partial(timing.measure_speed, budget=0.0)  # the fewest frames


def load_small(longest: int = 32, every: int = 1000) -> Capture:
    """The shipped capture with six small views and every so many of its points."""
    capture = load(DEMO / "buddha", resolution=f"longest:{longest}", max_views=6, split="mod8")
    assert capture.points is not None
    return replace(capture, points=Points(capture.points.xyz[::every], capture.points.rgb[::every]))


def answer(words: list[str], work: Callable[[str], Any]) -> int:
    """Do the work of each word with tensors that can pretend, and print the results by word as JSON. A failure is {"error": sentence}."""
    prepare()
    out: dict[str, Any] = {}
    with Pretending():
        for word in words:
            try:
                out[word] = work(word)
            except Exception as error:
                traceback.print_exc()
                out[word] = {"error": f"{type(error).__name__}: {str(error)[:500]}"}
    print(json.dumps(out))
    return 0
