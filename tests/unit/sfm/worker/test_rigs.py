"""Views that were cut out of panoramas, without pycolmap."""

from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np

from scene_experts.sfm.worker import rigs

RIG = {"views": {"front": np.eye(3).tolist(), "left": [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]]}}


def test_a_view_is_known_by_its_folder():
    assert (
        rigs.is_cut("front/a.jpg", {"rig": RIG})
        and not rigs.is_cut("front.jpg", {"rig": RIG})
        and not rigs.is_cut("front/a.jpg", {"rig": None})
    )


def test_views_are_tied_to_the_first_one_and_their_lenses_stay():
    tied = []

    @contextmanager
    def open_database(path):
        images = [SimpleNamespace(name=name, camera_id=i) for i, name in enumerate(("front/a.jpg", "left/a.jpg", "b.jpg"))]
        yield SimpleNamespace(read_all_images=lambda: images)

    colmap = SimpleNamespace(
        Database=SimpleNamespace(open=open_database),
        RigConfig=SimpleNamespace,
        RigConfigCamera=SimpleNamespace,
        Rotation3d=np.array,
        Rigid3d=lambda turn, place: (turn, place),
        apply_rig_config=lambda configs, database: tied.extend(configs[0].cameras),
    )
    rigs.tie_views(colmap, {"rig": RIG, "database": ""})
    first, second = tied
    assert (first.image_prefix, first.ref_sensor) == ("front/", True) and (second.image_prefix, second.ref_sensor) == ("left/", False)
    turn, place = second.cam_from_rig
    assert np.array_equal(turn, RIG["views"]["left"]) and place == [0.0, 0.0, 0.0]  # the first one is not turned
    assert rigs.find_cut_cameras(colmap, {"rig": RIG, "database": ""}) == {0, 1}
