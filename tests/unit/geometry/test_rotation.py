from __future__ import annotations

import torch

from scene_experts.geometry.rotation import covariance, estimate_up, matrix_to_quat, normalise_quats, quat_to_matrix


def quats(n: int) -> torch.Tensor:
    return normalise_quats(torch.randn(n, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64))


def hamilton(p: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    pw, pv, qw, qv = p[:, :1], p[:, 1:], q[:, :1], q[:, 1:]
    return torch.cat([pw * qw - (pv * qv).sum(1, keepdim=True), pw * qv + qw * pv + torch.linalg.cross(pv, qv)], dim=1)


def test_rotates_as_the_quaternion_product_does() -> None:
    q, v = quats(50), torch.randn(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    pure = torch.cat([torch.zeros(50, 1, dtype=torch.float64), v], dim=1)
    conjugate = q * q.new_tensor([1, -1, -1, -1])
    turned = hamilton(hamilton(q, pure), conjugate)[:, 1:]
    torch.testing.assert_close((quat_to_matrix(q) @ v[:, :, None]).squeeze(2), turned)


def test_quarter_turn_about_z_sends_x_to_y() -> None:
    half = 0.5**0.5
    matrix = quat_to_matrix(torch.tensor([half, 0.0, 0.0, half], dtype=torch.float64))
    torch.testing.assert_close(matrix[:, 0], torch.tensor([0.0, 1.0, 0.0], dtype=torch.float64))


def test_matrix_to_quat_inverts_also_half_turns() -> None:
    half_turns = torch.cat([torch.zeros(3, 1), torch.eye(3)], dim=1).double()
    q = torch.cat([quats(200), half_turns, -half_turns])
    back = matrix_to_quat(quat_to_matrix(q))
    assert (back[:, 0] >= 0).all()
    torch.testing.assert_close(back.norm(dim=1), torch.ones(206, dtype=torch.float64))
    torch.testing.assert_close(quat_to_matrix(back), quat_to_matrix(q))


def test_covariance_has_the_scales_as_axes() -> None:
    q, scales = quats(20), torch.rand(20, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64) + 0.1
    cov = covariance(q, scales)
    torch.testing.assert_close(torch.linalg.eigvalsh(cov), scales.square().sort(dim=1).values)
    axis = quat_to_matrix(q)[:, :, :1]
    torch.testing.assert_close(cov @ axis, axis * scales[:, :1, None] ** 2)


def test_zero_quaternion_stays_finite() -> None:
    q = torch.zeros(1, 4, requires_grad=True)
    cov = covariance(normalise_quats(q), torch.ones(1, 3))
    cov.sum().backward()
    torch.testing.assert_close(cov[0].detach(), torch.eye(3))
    assert q.grad is not None and q.grad.isfinite().all()


def ring(roll: list[float], pitch: float = 0.5) -> torch.Tensor:
    """Rotations [V, 3, 3] of cameras on a circle that look inwards, pitched down by `pitch` and rolled by `roll`; up is +z."""
    out = []
    for i, turn in enumerate(torch.tensor(roll, dtype=torch.float64)):
        a = torch.tensor(2 * torch.pi * i / len(roll), dtype=torch.float64)
        p = torch.tensor(pitch, dtype=torch.float64)
        forward = torch.stack([-a.cos() * p.cos(), -a.sin() * p.cos(), -p.sin()])
        right = torch.nn.functional.normalize(torch.linalg.cross(forward, torch.tensor([0.0, 0, 1], dtype=torch.float64)), dim=0)
        down = torch.linalg.cross(forward, right)
        out.append(torch.stack([turn.cos() * right + turn.sin() * down, turn.cos() * down - turn.sin() * right, forward], dim=1))
    return torch.stack(out)


def test_photographs_on_their_side_do_not_tilt_the_up_direction() -> None:
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    quarter = torch.pi / 2
    torch.testing.assert_close(estimate_up(ring([0.0] * 9)), up)
    for roll in ([0.0] * 4 + [quarter] * 5, [0.0, quarter, quarter, 0.0, 0.0, quarter, quarter, quarter, 0.0, 0.0, quarter]):
        rotations = ring(roll)
        mean = torch.nn.functional.normalize(-rotations[:, :, 1].mean(0), dim=0)
        assert float(estimate_up(rotations) @ up) > 0.995 > float(mean @ up)


def test_the_up_direction_of_cameras_that_look_one_way_is_their_mean() -> None:
    one = ring([0.0])
    torch.testing.assert_close(estimate_up(one), -one[0, :, 1])
    torch.testing.assert_close(estimate_up(one.expand(5, 3, 3)), -one[0, :, 1])
