"""The synthetic capture has the properties that its documentation states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from scene_experts.data.readers.colmap_model import ColmapImage
from support.synthetic import Synthetic, colours, hits, make_capture, quaternion, surface_points


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Synthetic:
    return make_capture(tmp_path_factory.mktemp("made"))


def test_views_differ_in_size_and_principal_points_are_off_centre(made: Synthetic) -> None:
    assert len({image.shape for image in made.images.values()}) == 3
    for lens in made.model.cameras.values():
        assert abs(lens.cx / lens.width - 0.5) > 0.04 and abs(lens.cy / lens.height - 0.5) > 0.04


def test_channels_are_far_apart(made: Synthetic) -> None:
    for image in made.images.values():
        r, g, b = np.moveaxis(image.astype(float), -1, 0)
        assert min(np.abs(r - b).mean(), np.abs(r - g).mean(), np.abs(g - b).mean()) > 20


def test_views_agree_on_the_colour_of_a_point(made: Synthetic) -> None:
    """Photo-consistency: an unoccluded point away from edges has its own colour in every view."""
    xyz = surface_points(600, np.random.default_rng(7))
    own, errors = colours(xyz), []
    for image in made.model.images:
        lens, pose = made.model.cameras[image.camera_id], image.world_to_cam()
        eye = -pose[:3, :3].T @ pose[:3, 3]
        seen = np.abs(hits(eye, xyz - eye) - 1) < 1e-6
        cam = xyz @ pose[:3, :3].T + pose[:3, 3]
        px = cam[:, :2] / cam[:, 2:] * (lens.fx, lens.fy) + (lens.cx, lens.cy)
        inside = seen & (px >= 1).all(1) & (px < (lens.width - 1, lens.height - 1)).all(1)
        at = px[inside].astype(int)
        errors.append(np.abs(made.images[image.name][at[:, 1], at[:, 0]] / 255 - own[inside]).max(1))
    error = np.concatenate(errors)
    assert len(error) > 2000 and np.median(error) < 0.04 and (error < 0.1).mean() > 0.85  # the rest lies at the edge of something


@pytest.mark.slow
def test_the_same_seed_makes_the_same_capture(made: Synthetic, tmp_path: Path) -> None:
    again, other = make_capture(tmp_path / "a"), make_capture(tmp_path / "b", seed=1)
    assert all(np.array_equal(made.images[name], again.images[name]) for name in made.images)
    assert not np.array_equal(made.images["view_000.png"], other.images["view_000.png"])


def test_the_unit_changes_no_pixel(made: Synthetic, tmp_path: Path) -> None:
    large = make_capture(tmp_path, scale=100.0)
    for name, image in made.images.items():
        assert (np.abs(image.astype(int) - large.images[name]) > 1).mean() < 1e-3
    np.testing.assert_allclose(large.model.xyz, 100 * made.model.xyz)


def test_quaternions_are_rotations() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        R = np.linalg.qr(rng.standard_normal((3, 3)))[0]
        R *= np.sign(np.linalg.det(R))
        q = quaternion(R)
        np.testing.assert_allclose(ColmapImage(1, "a", q, (0.0, 0.0, 0.0), 1).world_to_cam()[:3, :3], R, atol=1e-12)
