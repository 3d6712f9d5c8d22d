"""Quaternions (w, x, y, z), rotation matrices, and the covariance of a Gaussian (3DGS, eq. 6)."""

from __future__ import annotations

import torch
from torch import Tensor


def normalise_quats(quats: Tensor, eps: float = 1e-12) -> Tensor:
    """Normalise quaternions [..., 4]. Shorter ones than `eps` are divided by `eps`, so zero stays
    zero and there is no NaN."""
    return quats / quats.norm(dim=-1, keepdim=True).clamp_min(eps)


def quat_to_matrix(quats: Tensor) -> Tensor:
    """Rotation matrices [..., 3, 3] of unit quaternions [..., 4].

    The caller normalises the quaternions; gradients are with respect to the values passed. The zero
    quaternion gives the identity.
    """
    w, x, y, z = quats.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def matrix_to_quat(matrices: Tensor) -> Tensor:
    """Unit quaternions [..., 4] with w >= 0 of rotation matrices [..., 3, 3].

    The squares of the components follow from the diagonal. The signs follow from the off-diagonal
    sums divided by the largest component, so no divisor is small.
    """
    m = matrices
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]  # 4wx, 4wy, 4wz
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]  # 4xy, 4xz, 4yz
    # The outer product 4 q q^T: each row is the quaternion times four times one of its components.
    outer = torch.stack(
        [
            torch.stack([1 + xx + yy + zz, wx, wy, wz], -1),
            torch.stack([wx, 1 + xx - yy - zz, xy, xz], -1),
            torch.stack([wy, xy, 1 - xx + yy - zz, yz], -1),
            torch.stack([wz, xz, yz, 1 - xx - yy + zz], -1),
        ],
        dim=-2,
    )  # [..., 4, 4]
    largest = outer.diagonal(dim1=-2, dim2=-1).argmax(-1)  # [...]
    row = outer.gather(-2, largest[..., None, None].expand(*largest.shape, 1, 4)).squeeze(-2)
    quats = normalise_quats(row)
    return torch.where(quats[..., :1] < 0, -quats, quats)


def covariance(quats: Tensor, scales: Tensor) -> Tensor:
    """Covariances R S S^T R^T, [..., 3, 3] in squared world units, of unit quaternions [..., 4] and
    standard deviations [..., 3]."""
    half = quat_to_matrix(quats) * scales[..., None, :]
    return half @ half.transpose(-1, -2)


def estimate_up(rotations: Tensor) -> Tensor:
    """Unit up direction [3] of the world, from camera-to-world rotations [V, 3, 3] (x right, y
    down).

    The mean of the cameras' up axes is biased if some photographs lie on their side (portraits
    stored without rotation) or if the cameras look down from one side more often. This function
    starts from the mean and finds the direction that is most orthogonal to the more level axis,
    right or up, of each camera.
    """
    right, ups = rotations[:, :, 0].double(), -rotations[:, :, 1].double()
    mean = ups.mean(0)
    mean = mean / mean.norm().clamp_min(1e-12)
    up = mean
    off = torch.eye(3, dtype=torch.float64, device=up.device) - mean[:, None] * mean
    for _ in range(5):  # until the level axis of each camera is known
        level = torch.where(((right @ up).abs() < (ups @ up).abs())[:, None], right, ups)
        # cameras that all look one way exclude only one axis; the last term then stays near the
        # mean
        up = torch.linalg.eigh(level.T @ level / len(level) + 0.02 * off)[1][:, 0]
        up = up if float(up @ mean) >= 0 else -up
    return up
