"""Events of a training, for its listeners: the terminal, the run folder, the viewer, a script."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from torch import Tensor

from scene_experts.scene import Traits
from scene_experts.strategy import Edit
from scene_experts.training.course import Course


@dataclass(frozen=True)
class Started:
    """The training begins, or resumes. It is the first event."""

    step: int
    """Number of iterations already trained: 0, or where the run resumes."""
    total: int
    """The last iteration of this training."""
    anchors: int
    """Number of rows: anchors, Gaussians or graph points."""
    traits: Traits
    """What the scene is and can do."""
    decode: str = ""
    """Which implementation decodes the scene in the first iteration, and why not the fused one;
    empty without a choice."""
    start: str = ""
    """What the scene starts from: how many points were computed of what, and depth maps that count."""
    gradients: str = ""
    """On a GPU: whether training views are differentiated without autograd, and why not."""
    course: Course | None = None
    """How long its iterations are expected to take, relative to each other; None: all alike."""


@dataclass(frozen=True)
class Stepped:
    """Figures of an iteration and of the one view that it saw. Yielded every 10 iterations unless
    asked otherwise."""

    step: int
    """The iteration, counted from 1."""
    terms: dict[str, float]
    """Terms of the loss by name, weighted; their sum is the loss."""
    psnr: float | None
    """PSNR of the training view, dB, where its mask counts; None if it counts nowhere."""
    anchors: int
    """Number of rows: anchors, Gaussians or graph points."""
    visible: int
    """Number of rows that this view decoded."""
    gaussians: int
    """Number of Gaussians handed to the rasteriser: those of the visible rows with positive
    opacity."""
    active: float
    """Share of the decoded Gaussians with positive opacity, 0 to 1; 0 for scenes without
    decoders."""
    seconds: float
    """Wall time of the iterations so far, s, without saving and previews."""
    routing: dict[str, list[float]]
    """Each expert's share of this view's anchors, 0 to 1, by attribute; its share of the gates
    during the dense warm-up."""
    balance: dict[str, float] = field(default_factory=dict)
    """Load-balancing loss by attribute, L_load^S / k (L_load^D during the dense warm-up); 1 is
    perfect balance."""
    entropy: dict[str, float] = field(default_factory=dict)
    """Entropy of the gates by attribute, 0 to 1: 1 if all experts count alike, 0 if one counts
    alone."""
    scene_routing: dict[str, list[float]] = field(default_factory=dict)
    """As `routing`, of anchors sampled all over the scene."""
    scene_gates: dict[str, list[float]] = field(default_factory=dict)
    """Mean gate of each expert over the same anchors, 0 to 1, by attribute."""


@dataclass(frozen=True)
class Densified:
    """Densification added or removed rows."""

    step: int
    """The iteration."""
    edit: Edit
    """Numbers of rows grown and pruned, rows afterwards, and whether a limit held growth back."""


@dataclass(frozen=True)
class Previewed:
    """A held-out view (a training view if none is held out) was rendered."""

    step: int
    """The iteration."""
    view: int
    """Index of the view in the capture."""
    picture: Tensor
    """[H, W, 3] float32 on the CPU, RGB in [0, 1]."""


@dataclass(frozen=True)
class Saved:
    """A checkpoint was written."""

    step: int
    """The iteration."""
    path: Path
    """The checkpoint file."""


@dataclass(frozen=True)
class Stopped:
    """The training was stopped early, and is saved. It is the last event."""

    step: int
    """The last iteration trained."""
    reason: str
    """The reason given, for example "SIGINT"."""


@dataclass(frozen=True)
class Exported:
    """The scene was written to the run folder in the layout that other tools read."""

    step: int
    """The iteration."""
    path: Path
    """The folder RUN/point_cloud/iteration_N."""
    warnings: tuple[str, ...] = ()
    """What other readers of the layout get wrong, one sentence each."""
    notes: tuple[str, ...] = ()
    """What was measured for later exports, one sentence each."""


@dataclass(frozen=True)
class Finished:
    """The training is complete. It is the last event."""

    step: int
    """The last iteration."""
    seconds: float
    """Wall time of all iterations, s, without saving and previews."""


Event = Started | Stepped | Densified | Previewed | Saved | Stopped | Exported | Finished
