"""Whether a pair has a wide angle, without pycolmap."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from scene_experts.sfm.worker import mappers


@pytest.mark.parametrize(("angles", "wide"), [([4.0, 15.0, 3.0], True), ([4.0, 9.0, 14.0], False), ([], False)])
def test_the_first_pair_is_searched_with_half_of_the_angle_where_no_pair_has_all(angles, wide):
    """Pairs of 200, 199, ... inliers with these angles, and one of 40 inliers and 30 degrees, which is too weak to begin with."""
    count = len(angles) + 2
    told = [SimpleNamespace(inlier_matches=[0] * (200 - i), degrees=angle, tri_angle=-1.0) for i, angle in enumerate(angles)]
    weak = SimpleNamespace(inlier_matches=[0] * 40, degrees=30.0, tri_angle=-1.0)

    @contextmanager
    def open_database(path):
        yield SimpleNamespace(
            read_all_images=lambda: [SimpleNamespace(image_id=i, camera_id=1) for i in range(count)],
            read_all_cameras=lambda: [SimpleNamespace(camera_id=1)],
            read_two_view_geometries=lambda: (list(range(len(angles) + 1)), [*told, weak]),
            read_keypoints=lambda i: np.zeros((3, 6), np.float32),
        )

    def estimate(camera1, points1, camera2, points2, geometry):
        assert points1.shape == points2.shape == (3, 2)
        geometry.tri_angle = np.radians(geometry.degrees)
        return True

    colmap = SimpleNamespace(
        Database=SimpleNamespace(open=open_database),
        pair_id_to_image_pair=lambda key: (key, key + 1),
        estimate_two_view_geometry_pose=estimate,
    )
    mapper = SimpleNamespace(init_min_num_inliers=100, init_min_tri_angle=16.0)
    colmap.IncrementalPipelineOptions = lambda: SimpleNamespace(mapper=mapper)
    assert mappers.has_wide_pair(colmap, {"database": ""}) is wide
