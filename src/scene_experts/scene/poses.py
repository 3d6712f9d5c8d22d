"""Small motions of the training cameras, learned with the scene.

The refined pose of a training view is exp(m) world_to_cam, with a motion m in se(3) of each view:
its rotation about the axes of the camera (rad) and its translation along them (in extents of the
capture). Drawing with exp(m) world_to_cam is drawing Gaussians that have moved by
world_to_cam^-1 exp(m) world_to_cam, so the gradient of a pose is a sum over the gradients of means
and quaternions that the rasteriser gives anyway: their force and their torque (`attach`).

What the decode sees of a camera, its place, moves with the pose, but is taken as a constant of the
gradient: on fox the rest is at most 0.003 of the whole where a pose is 0.3 degrees off, and 0.08
where it is right (results/poses.md).

Moving, turning or scaling the whole world changes no picture. The part of the motions that does so
to first order is taken out, by least squares, so that the scene stays where it is.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from scene_experts.core.schedule import Rate
from scene_experts.core.types import Camera, Gaussians
from scene_experts.geometry.poses import exp_motion, log_motion
from scene_experts.scene.per_view import PerView

GROUP = "poses"  # name of the learning rate, and of the tensors in a checkpoint
RATE = Rate(1e-4, 1e-6)  # rad and extents, from the start of the training to the end
BEGIN, FULL = 0.05, 0.15  # shares of the training: until the first no pose moves, from the second on at the whole rate
BUFFERS = ("ids", "gauge", "extent", "begun")
_BLOCK = 2048  # rows of a product of matrices


class Poses(PerView):
    """Motions of the training cameras, by the ids of their cameras."""

    group, learned, buffers_kept = GROUP, "motions", BUFFERS
    motions: nn.Parameter  # [V, 6] rotation, translation
    gauge: Tensor  # [V, 6, G] orthonormal columns: motions of the whole world
    extent: Tensor  # [] trained world units
    begun: Tensor  # [V, 6] the motions that the training begins with: those of the whole world are taken out of what follows

    def __init__(self, cameras: Sequence[Camera], extent: float) -> None:
        """extent: that of the capture, in trained world units."""
        super().__init__()
        self.motions = nn.Parameter(torch.zeros(len(cameras), 6))
        self.set_cameras(cameras)
        self.register_buffer("gauge", find_gauge(cameras, extent).float())
        self.register_buffer("extent", torch.tensor(float(extent)))
        self.register_buffer("begun", torch.zeros(len(cameras), 6))

    def continue_from(self, earlier: Poses) -> None:
        """Take the motions of the views that an earlier training has refined."""
        with torch.no_grad():
            found = earlier.without_gauge()
            for id, row in self.row.items():
                if id in earlier.row:
                    self.motions[row] = self.begun[row] = found[earlier.row[id]]

    @torch.no_grad()
    def begin_at(self, cameras: Sequence[Camera], adjusted: Sequence[Camera]) -> None:
        """Begin with the motions that take the training cameras to their `adjusted` poses."""
        for camera, other in zip(cameras, adjusted):
            pose = other.world_to_cam.double() @ torch.linalg.inv(camera.world_to_cam.double())
            turn, move = log_motion(pose).split(3)
            row = self.row[camera.id]
            self.motions[row] = self.begun[row] = torch.cat([turn, move / self.extent.double()]).to(self.motions)

    def without_gauge(self) -> Tensor:
        """Return the motions [V, 6] without those of the whole world."""
        along = (self.gauge * (self.motions - self.begun)[:, :, None]).sum(1).sum(0)  # [G]
        return self.motions - (self.gauge * along).sum(2)

    def pose_of(self, camera: Camera) -> Tensor | None:
        """Return the refined pose [4, 4] float64 of a training camera, with a graph; None for
        another camera."""
        row = self.row.get(camera.id)
        if row is None:
            return None
        rotation, translation = self.without_gauge()[row].double().split(3)
        return exp_motion(torch.cat([rotation, translation * self.extent])) @ camera.world_to_cam.to(self.motions.device).double()

    @torch.no_grad()
    def refine(self, camera: Camera) -> Camera:
        """Return a training camera at its refined pose, another one as it is."""
        pose = self.pose_of(camera)
        return camera if pose is None else at_pose(camera, pose)

    def learning_rate(self, step: int, total: int) -> float:
        """Return the learning rate at `step` of `total`."""
        rise = (step / total - BEGIN) / (FULL - BEGIN)
        return RATE.at(step, total) * min(1.0, max(0.0, rise))

    @torch.no_grad()
    def describe(self) -> str:
        """Say how far the poses have moved."""
        found = self.without_gauge()
        turn, shift = (part.norm(dim=1).median().item() for part in found.split(3, dim=1))
        return f"median rotation {math.degrees(turn):.3f} degrees, median translation {100 * shift:.3f} % of the extent"


def at_pose(camera: Camera, pose: Tensor) -> Camera:
    """Return the camera at another pose [4, 4], on its device and of its dtype."""
    moved = replace(camera, world_to_cam=pose.detach().to(camera.world_to_cam))
    moved.__dict__["pinhole"] = camera.pinhole
    return moved


def attach(g: Gaussians, pose: Tensor) -> Gaussians:
    """Return the same Gaussians; the gradients of their means and quaternions are also those of the
    pose [4, 4] that they are drawn with."""
    means, quats = _Attach.apply(g.means, g.quats, pose)
    return replace(g, means=means, quats=quats)


class _Attach(torch.autograd.Function):
    """The identity on means and quaternions, with `pose_gradient`."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, quats: Tensor, pose: Tensor):  # type: ignore[override]
        ctx.save_for_backward(means, quats, pose)
        return means.view_as(means), quats.view_as(quats)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, d_means: Tensor, d_quats: Tensor):  # pyright: ignore[reportIncompatibleMethodOverride]
        means, quats, pose = ctx.saved_tensors
        return d_means, d_quats, pose_gradient(means, quats, d_means, d_quats, pose) if ctx.needs_input_grad[2] else None


@torch.no_grad()
def pose_gradient(means: Tensor, quats: Tensor, d_means: Tensor, d_quats: Tensor, pose: Tensor) -> Tensor:
    """Return the gradient [4, 4] of a pose from those of the means [M, 3] and quaternions [M, 4]
    that are drawn with it.

    With F = d loss / d means, the gradient of the translation is R sum F. A rotation by w about the
    axes of the world moves means by w x mean, and quaternions by (0, w) q / 2; so the torque is T =
    sum (mean x F + (q0 f - f0 q + q x f) / 2), where (f0, f) is d loss / d quaternion. A gradient of
    the matrix R whose product with every turn R skew(w) is w T, is R skew(T) / 2.

    The entries of T are differences of the sums of products of two columns, which are two small
    products of matrices.
    """
    moved, turned = _product(means, d_means), _product(quats, d_quats)
    spin = turned - turned.T
    torque = _axis(moved - moved.T) + (spin[0, 1:] + _axis(spin[1:, 1:])) / 2
    force, torque = d_means.sum(0).to(pose), torque.to(pose)
    R, out = pose[:3, :3], torch.zeros_like(pose)
    out[:3, :3], out[:3, 3] = R @ skew(torque) / 2, R @ force
    return out


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Return a^T b [C, C] of a, b [M, C], by blocks of rows: with one product, some processors add up
    in another order with another number of threads."""
    whole = len(a) // _BLOCK * _BLOCK
    blocks = torch.bmm(a[:whole].reshape(-1, _BLOCK, a.shape[1]).transpose(1, 2), b[:whole].reshape(-1, _BLOCK, b.shape[1]))
    return blocks.sum(0) + (a[whole:, :, None] * b[whole:, None, :]).sum(0)


def _axis(m: Tensor) -> Tensor:
    """Return the entries (1, 2), (2, 0) and (0, 1) of a matrix [3, 3]: the sum of a x b for a^T b
    minus its transpose."""
    return torch.stack([m[1, 2], m[2, 0], m[0, 1]])


def skew(v: Tensor) -> Tensor:
    """Return the matrix [3, 3] of the cross product with v [3]."""
    x, y, z = v.unbind()
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o]).view(3, 3)


def find_gauge(cameras: Sequence[Camera], extent: float) -> Tensor:
    """Return an orthonormal basis [V, 6, G] float64 of the motions of cameras that a motion (6) or a
    scaling (1) of the world makes, to first order; G <= 7.

    A world that turns by w, moves by u and grows by s takes a point x to x + w x x + u + s x. The
    motion of a camera with pose (R, t) is then: rotation R w, translation R u + t x R w - s t.
    """
    columns = []
    for camera in cameras:
        pose = camera.world_to_cam.cpu().double()
        R, t = pose[:3, :3], pose[:3, 3]
        turn = torch.cat([R, R.new_zeros(3, 3), R.new_zeros(3, 1)], 1)
        shift = torch.cat([skew(t) @ R, R, -t[:, None]], 1) / extent
        columns.append(torch.cat([turn, shift]))
    whole = torch.cat(columns)  # [6 V, 7]
    whole = whole / whole.norm(dim=0).clamp_min(1e-12)
    u, size, _ = torch.linalg.svd(whole, full_matrices=False)
    kept = u[:, size > 1e-6 * size.max()]
    return kept.reshape(len(cameras), 6, -1)
