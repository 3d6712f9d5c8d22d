"""Draws what a picture can show of a scene: colours, depth, opacity, or how the experts share the
rows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from scene_experts.core.errors import InputError
from scene_experts.core.types import Camera, Decoded, Mode, Render
from scene_experts.evaluate.experts import assign_gaussians, select_gaussians
from scene_experts.render import Rasterizer
from scene_experts.scene import Draws, Scene, Traits
from scene_experts.view.show import SHOWS, Show

PALETTE = (  # colours that colour-blind readers can distinguish (Okabe and Ito), then darker ones
    (0.00, 0.45, 0.70), (0.84, 0.37, 0.00), (0.00, 0.62, 0.45), (0.80, 0.47, 0.65), (0.90, 0.62, 0.00), (0.34, 0.71, 0.91),
    (0.94, 0.89, 0.26), (0.50, 0.50, 0.50), (0.00, 0.27, 0.42), (0.50, 0.22, 0.00), (0.00, 0.37, 0.27), (0.48, 0.28, 0.39),
    (0.54, 0.37, 0.00), (0.20, 0.43, 0.55), (0.56, 0.53, 0.16), (0.25, 0.25, 0.25),
)  # fmt: skip
LOW, MIDDLE, HIGH = (0.05, 0.03, 0.30), (0.75, 0.20, 0.45), (1.00, 0.90, 0.35)  # a dark-to-light ramp


@dataclass(frozen=True, kw_only=True)
class Look:
    """What a picture shows."""

    show: Show = "picture"
    attribute: str = "color"  # the attribute whose experts are shown
    only: tuple[int, ...] | None = None  # draw only the rows of these experts; None: all rows
    box: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None  # crop: lower and upper corner, trained world


def available_shows(traits: Traits) -> tuple[Show, ...]:
    """Return what a scene with these traits can show."""
    usable = {"experts": traits.experts > 0, "entropy": traits.experts > 0, "activation": traits.activation}
    return tuple(show for show in SHOWS if usable.get(show, True))


@torch.no_grad()
def paint(
    scene: Scene,
    camera: Camera,
    step: int,
    rasterize: Rasterizer,
    background: Tensor,
    look: Look = Look(),
    draws: Draws | None = None,
) -> Tensor:
    """Draw a picture [H, W, 3] in [0, 1].

    Args:
        background: RGB [3] in [0, 1] on the scene's device.
        draws: The same scene frozen (`Scene.frozen`), which is faster. Expert pictures need the
            routing and do not use it.

    Raises:
        InputError: if the look needs experts or an activation ratio and the scene has none, or not
            yet.
    """
    routed = look.only is not None or look.show in ("experts", "entropy")
    decoded = (scene if draws is None or routed else draws)(camera, step, Mode.DRAW, rasterize.visible)
    if routed and not decoded.routing and step <= scene.traits.dense_until:
        raise InputError(
            f"expected a scene whose parts have their own experts, from iteration {scene.traits.dense_until + 1} on, found one network for "
            f"all of it at iteration {step}; continue the training, or leave --show and --only out"
        )
    gaussians = decoded.gaussians
    if look.only is not None:
        mine = assign_gaussians(require_routing(decoded, look.attribute), look.attribute, scene.K)
        wanted = [e for e in look.only if 0 <= e < mine.shape[1]]
        mask = mine[:, wanted].any(1)
        gaussians = select_gaussians(gaussians, mask)
    if look.box is not None:
        low, high = (gaussians.means.new_tensor(corner) for corner in look.box)
        gaussians = select_gaussians(gaussians, ((gaussians.means >= low) & (gaussians.means <= high)).all(1))
    if look.show in ("experts", "entropy", "activation"):
        colours = color_rows(decoded, look)
        place = torch.searchsorted(decoded.rows, torch.div(gaussians.source, scene.K, rounding_mode="floor"))
        gaussians = replace(gaussians, colors=colours.index_select(0, place))
    return to_picture(rasterize(gaussians, camera, background), look.show)


def to_picture(render: Render, show: Show) -> Tensor:
    """Return the colours, the opacity or the depth of a render as a picture [H, W, 3] in [0, 1].
    Near is light."""
    if show == "alpha":
        return render.alpha[..., None].expand(-1, -1, 3).clamp(0, 1)
    if show == "depth":
        seen = render.alpha > 0.5
        z = render.depth / render.alpha.clamp_min(1e-6)
        if not bool(seen.any()):
            return torch.zeros_like(render.image)
        near, far = torch.quantile(z[seen][:: max(1, int(seen.sum()) // 100_000)], torch.tensor([0.02, 0.98], device=z.device)).tolist()
        inverse = (1 / z.clamp(near, far) - 1 / far) / max(1 / near - 1 / far, 1e-12)  # equal steps of disparity
        return torch.where(seen[..., None], color_ramp(inverse), 0.0)
    return render.image.clamp(0, 1)


def measure_depth(render: Render) -> Tensor:
    """Return the mean depth of what is drawn, [H, W], trained units; 0 where nothing is drawn."""
    return torch.where(render.alpha > 0, render.depth / render.alpha.clamp_min(1e-12), 0.0)


def color_rows(decoded: Decoded, look: Look) -> Tensor:
    """Return a colour in [0, 1] for each decoded row, [A, 3]."""
    if look.show == "activation":
        if decoded.raw_opacity is None:
            raise InputError(
                "expected a scene whose opacities come from a network, found Gaussians with fixed opacities; choose another --show"
            )
        return color_ramp((decoded.raw_opacity > 0).to(decoded.raw_opacity.dtype).mean(1))
    routing = require_routing(decoded, look.attribute).routing[look.attribute]
    gates = routing.gates.detach()
    if look.show == "entropy":
        experts = max(gates.shape[1], 2)
        return color_ramp(torch.special.entr(gates).sum(1) / torch.log(torch.tensor(float(experts))))
    weights = gates
    if routing.chosen is not None:
        weights = torch.zeros_like(gates).scatter_(1, routing.chosen, gates.gather(1, routing.chosen))
        weights = weights / weights.sum(1, keepdim=True).clamp_min(1e-12)
    palette = torch.tensor(PALETTE, dtype=gates.dtype, device=gates.device)[torch.arange(gates.shape[1]) % len(PALETTE)]
    return weights @ palette


def require_routing(decoded: Decoded, attribute: str) -> Decoded:
    """Return `decoded`. Raises InputError if it has no routing of `attribute`."""
    if attribute not in decoded.routing:
        known = ", ".join(decoded.routing) or "a scene without experts"
        raise InputError(f"expected a scene with experts of {attribute}, found {known}; choose another --show or --attribute")
    return decoded


def color_ramp(value: Tensor) -> Tensor:
    """Map values in [0, 1] to colours [..., 3], from dark to light."""
    low, middle, high = (torch.tensor(c, dtype=value.dtype, device=value.device) for c in (LOW, MIDDLE, HIGH))
    v = value.clamp(0, 1)[..., None]
    return torch.where(v < 0.5, low + (middle - low) * (2 * v), middle + (high - middle) * (2 * v - 1))
