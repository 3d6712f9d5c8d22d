"""Distortions with a closed form, by the equations that define them."""

from __future__ import annotations

import numpy as np
import pytest

from scene_experts.data import lens_forms as forms

U, V = np.random.default_rng(0).uniform(-0.8, 0.8, (2, 200))


@pytest.mark.parametrize("k", [-0.3, 0.2])
def test_the_division_model(k: float) -> None:
    """The undistorted point is the distorted one divided by 1 + k r^2."""
    x, y = forms.distort_division(k, U, V)
    r2 = x * x + y * y
    np.testing.assert_allclose((x / (1 + k * r2), y / (1 + k * r2)), (U, V), atol=1e-12)
    np.testing.assert_allclose(forms.undistort_division(k, x, y), (U, V), atol=1e-12)
    assert np.isnan(forms.undistort_division(-0.3, np.array([2.0]), np.array([0.0]))).all()
    assert np.isnan(forms.distort_division(0.2, np.array([5.0]), np.array([0.0]))).all()


@pytest.mark.parametrize(("alpha", "beta"), [(0.0, 1.0), (0.4, 0.8), (0.6, 1.2)])
def test_the_enhanced_unified_model(alpha: float, beta: float) -> None:
    x, y = forms.distort_unified(alpha, beta, U, V)
    for u, v, a, b in zip(U[:20], V[:20], x, y):
        depth = alpha * np.sqrt(beta * (u * u + v * v) + 1) + (1 - alpha)
        assert (a, b) == pytest.approx((u / depth, v / depth), abs=1e-12)
    np.testing.assert_allclose(forms.undistort_unified(alpha, beta, x, y), (U, V), atol=1e-9)


def test_rays_beyond_88_degrees_are_clamped() -> None:
    wide = np.array([1.8]), np.array([0.0])
    assert forms.undistort_unified(0.6, 1.2, *wide)[0][0] == pytest.approx(np.tan(forms.LARGEST_ANGLE), rel=1e-6)
    assert forms.undistort_fov(1.5, *wide)[0][0] > 10


def test_the_field_of_view_model() -> None:
    """r' = atan(2 r tan(omega / 2)) / omega."""
    x, y = forms.distort_fov(0.7, U, V)
    r = np.hypot(U, V)
    np.testing.assert_allclose(np.hypot(x, y), np.arctan(2 * r * np.tan(0.35)) / 0.7, atol=1e-12)
    np.testing.assert_allclose(forms.undistort_fov(0.7, x, y), (U, V), atol=1e-9)
