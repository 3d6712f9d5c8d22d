"""One view of a training without a graph: each part draws, and then goes backward.

On a GPU the host needs several times as long to build a graph of autograd and to walk through it as
the device needs for the kernels. Here the parts are called one after the other. Where no kernel
covers a scene, it goes through autograd, and the picture and the loss are direct all the same. The
reference is `loop.see_view` with autograd: random numbers, values and gradients are the same.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from scene_experts.core.gradients import BackwardScene, GaussianGradients, Regularisers
from scene_experts.core.lazy import LazyMapping
from scene_experts.core.types import Camera, Decoded, Mode, Render
from scene_experts.render import Rasterizer, draw_with_gradients, explain_indirect
from scene_experts.scene import Cull, DirectScene, Scene
from scene_experts.scene.poses import at_pose, pose_gradient
from scene_experts.training.losses import Sample, Weights, compute_scene_terms, compute_terms
from scene_experts.training.photometric import photometric_gradients

PARTS = ("means", "quats", "scales", "opacities", "colors")
Seen = tuple[Decoded, Render, LazyMapping[Tensor]]
"""A decoded view, its picture and the terms of its loss, without a graph."""


class DirectStep:
    """Draws the views of a training. It finds out anew what draws the scene when its rows change or
    its dense warm-up ends."""

    def __init__(self, rasterize: Rasterizer, weights: Weights) -> None:
        self.rasterize, self.weights = rasterize, weights
        foreign = weights.terms is not Weights.terms
        self.refused = "a loss with other terms" if foreign else explain_indirect(rasterize) or ""  # why autograd draws the views
        self.scene: Scene | None = None
        self.drawing: DirectScene | None = None
        self.version = -1
        self.dense = False
        self.why = ""  # why the scene goes through autograd; "": it does not

    def prepare(self, scene: Scene, step: int) -> DirectScene:
        """Return what draws the scene at `step`."""
        version, dense = scene.table.version, step <= scene.dense_until
        if scene is not self.scene or version != self.version or dense != self.dense:
            self.drawing = None  # frees the gradients of the rows that were
            found = scene.direct(step, self.weights.load != 0)
            self.why, self.drawing = (found, ThroughAutograd(scene, self.weights)) if isinstance(found, str) else ("", found)
            self.scene, self.version, self.dense = scene, version, dense
        assert self.drawing is not None
        return self.drawing

    def forget(self) -> None:
        """Let go of the columns and gradients of the scene, before its rows change."""
        self.scene = self.drawing = None

    def describe(self, scene: Scene, step: int) -> str:
        """Say how the view of iteration `step` is differentiated, for the start of a training."""
        if self.refused:
            return f"through autograd ({self.refused})"
        self.prepare(scene, step)
        return f"without autograd, but for the decode ({self.why})" if self.why else "without autograd"

    @torch.no_grad()
    def see(self, scene: Scene, camera: Camera, number: int, target: Tensor, mask: Tensor | None, background: Tensor) -> Seen:
        """Draw a training view as iteration `number`, and add the gradients of its loss to the
        gradients of the parameters.

        target [H, W, 3], mask [H, W] or None and background [3] are on the device of the scene.
        Returns the decoded view, its picture and the terms of the loss.
        """
        w = self.weights
        with torch.enable_grad():
            pose = None if scene.poses is None else scene.poses.pose_of(camera)
        camera = camera if pose is None else at_pose(camera, pose)
        decoded, backward_scene = self.prepare(scene, number).draw(camera, number, self.rasterize.visible)
        render, backward_picture = draw_with_gradients(self.rasterize, decoded.gaussians, camera, background)
        shown, go_back = (render.image, None) if scene.exposures is None else scene.exposures.expose_directly(render.image, camera)
        gradient = photometric_gradients(shown, target, w.dssim, w.weigh_pixels(shown, target, mask, number))
        gradients = backward_picture(gradient if go_back is None else go_back(gradient))
        if pose is not None and pose.requires_grad:
            g = decoded.gaussians
            pose.backward(pose_gradient(g.means, g.quats, gradients.means, gradients.quats, pose))
        render = replace(render, image=shown)
        terms = LazyMapping(lambda: compute_terms(Sample(decoded, render, target, mask, number), w))
        if w.regularises:  # these see parameters, which the optimiser is about to move
            dict(terms)
        hinge = w.opacity if w.has_hinge(number) else 0.0
        backward_scene(gradients, Regularisers(w.scale, hinge, w.tau, w.load, w.mean_opacity, w.mean_size))
        return decoded, render, terms


class ThroughAutograd:
    """Draws a scene by its own `forward`."""

    def __init__(self, scene: Scene, weights: Weights) -> None:
        self.scene, self.weights = scene, weights

    def draw(self, camera: Camera, step: int, cull: Cull) -> tuple[Decoded, BackwardScene]:
        """See `DirectScene.draw`. The regularisers are computed as terms of the loss."""
        with torch.enable_grad():
            decoded = self.scene(camera, step, Mode.TRAIN, cull)
        g, raw, population = decoded.gaussians, decoded.raw_opacity, decoded.population
        without = replace(
            decoded,
            gaussians=replace(g, **{name: getattr(g, name).detach() for name in PARTS}),
            raw_opacity=None if raw is None else raw.detach(),
            routing={a: replace(r, gates=r.gates.detach()) for a, r in decoded.routing.items()},
            population=None if population is None else (population[0].detach(), population[1].detach()),
        )

        def backward(gradients: GaussianGradients, terms: Regularisers) -> None:
            ends = [(getattr(g, name), getattr(gradients, name)) for name in PARTS]
            with torch.enable_grad():
                terms_of_scene = compute_scene_terms(decoded, step, self.weights)
            ends += [(term, torch.ones_like(term)) for term in terms_of_scene.values()]
            wanted = [(end, gradient) for end, gradient in ends if end.requires_grad]
            if wanted:
                torch.autograd.backward([end for end, _ in wanted], [gradient for _, gradient in wanted])

        return without, backward
