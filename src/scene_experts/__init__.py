"""Scene Experts: anchor-based 3D Gaussian splatting with a mixture of experts (MoE-GS, AAAI 2026),
and its baselines.

    import scene_experts as se

    capture = se.load_capture("demo/buddha", resolution="longest:400")
    run = se.train(se.recipe("moe-gs", iterations=3000), capture, "runs/buddha")
    image = run.render(run.test_cameras[0])  # float32 [H, W, 3] in [0, 1]

The names are loaded when they are first used, so that the import takes milliseconds.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING

from scene_experts.core.version import __version__

# OpenMP's threads sleep between torch's operations instead of spinning, where torch is not loaded
# yet: spinning, they take the cores from
# the native library's own threads (4.7x slower training on two cores, ten times on a busy machine).
# It changes no number.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("KMP_BLOCKTIME", "0")

if TYPE_CHECKING:
    from scene_experts.api.camera import Camera as Camera
    from scene_experts.api.capture import Capture as Capture
    from scene_experts.api.capture import load_capture as load_capture
    from scene_experts.api.recipe import Recipe as Recipe
    from scene_experts.api.recipe import list_recipes as list_recipes
    from scene_experts.api.recipe import recipe as recipe
    from scene_experts.api.run import Layers as Layers
    from scene_experts.api.run import Run as Run
    from scene_experts.api.run import Scores as Scores
    from scene_experts.api.run import import_run as import_run
    from scene_experts.api.run import open_run as open_run
    from scene_experts.api.trainer import Trainer as Trainer
    from scene_experts.api.trainer import train as train
    from scene_experts.core.errors import InputError as InputError
    from scene_experts.core.errors import RunError as RunError
    from scene_experts.making.make import MadeScene as MadeScene
    from scene_experts.making.make import make as make
    from scene_experts.sfm.options import SourceOptions as SourceOptions
    from scene_experts.training.events import Densified as Densified
    from scene_experts.training.events import Event as Event
    from scene_experts.training.events import Exported as Exported
    from scene_experts.training.events import Finished as Finished
    from scene_experts.training.events import Previewed as Previewed
    from scene_experts.training.events import Saved as Saved
    from scene_experts.training.events import Started as Started
    from scene_experts.training.events import Stepped as Stepped
    from scene_experts.training.events import Stopped as Stopped

__all__ = [
    "Camera",
    "Capture",
    "Densified",
    "Event",
    "Exported",
    "Finished",
    "InputError",
    "Layers",
    "MadeScene",
    "Previewed",
    "Recipe",
    "Run",
    "RunError",
    "Saved",
    "Scores",
    "SourceOptions",
    "Started",
    "Stepped",
    "Stopped",
    "Trainer",
    "__version__",
    "import_run",
    "list_recipes",
    "load_capture",
    "make",
    "open_run",
    "recipe",
    "train",
]

_MODULES = {
    "api.camera": ("Camera",),
    "api.capture": ("Capture", "load_capture"),
    "api.recipe": ("Recipe", "list_recipes", "recipe"),
    "api.run": ("Layers", "Run", "Scores", "import_run", "open_run"),
    "api.trainer": ("Trainer", "train"),
    "core.errors": ("InputError", "RunError"),
    "making.make": ("MadeScene", "make"),
    "sfm.options": ("SourceOptions",),
    "training.events": ("Densified", "Event", "Exported", "Finished", "Previewed", "Saved", "Started", "Stepped", "Stopped"),
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> object:
    """Load a public name from its module (PEP 562)."""
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from scene_experts.arguments.docs import explain

    value = getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)
    explain(value)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
