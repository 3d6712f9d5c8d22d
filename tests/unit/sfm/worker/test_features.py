"""Features of photographs, without pycolmap."""

from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from scene_experts.sfm.worker import features


def test_the_smallest_features_are_left_out_where_two_photographs_have_enough_others(tmp_path, monkeypatch, capsys):
    """A photograph of this COLMAP has so many features of two orientations as its name says, twice as many with the smallest ones."""
    kept: dict[str, dict[str, int]] = {}

    class Database:
        def __init__(self, path):
            self.path = path

        def read_all_images(self):
            return [SimpleNamespace(name=name, image_id=name, camera_id=7) for name in kept.get(self.path, {})]

        def exists_descriptors(self, name):
            return True

        def read_keypoints(self, name):
            return np.repeat(np.arange(4.0 * kept[self.path][name]).reshape(-1, 4), 2, axis=0)

    class Opened(Database):
        @staticmethod
        @contextmanager
        def open(path):
            yield Database(path)

    def extract(database, images, names, *, extraction_options, **_):
        there = 1 if extraction_options.sift.first_octave == 0 else 2
        Path(database).touch()
        kept.setdefault(database, {}).update({name: there * int(name.split(".")[0].split("/")[-1]) for name in names})

    def made():
        return SimpleNamespace(sift=SimpleNamespace(max_num_features=8192, first_octave=-1))

    colmap = SimpleNamespace(
        FeatureExtractionOptions=made,
        ImageReaderOptions=SimpleNamespace,
        extract_features=extract,
        Database=Opened,
        CameraMode=SimpleNamespace(SINGLE=0),
        Device=SimpleNamespace(cpu=0),
    )
    ask = {"images": "", "masks": "", "camera_model": "OPENCV", "rig": None, "threads": 1, "max_side": 1600}
    rich, some = [f"{9000 + i}.jpg" for i in range(12)], [f"{4000 + i}.jpg" for i in range(12)]
    for case, (names, enough, large) in enumerate([(rich, None, True), (some, None, False), (some, 3000, True), (rich[:7], None, False)]):
        database = str(tmp_path / f"{case}.db")
        assert features.extract_features(colmap, {**ask, "database": database, "groups": [names], "enough": enough}) is large
        assert set(kept[database]) == set(names)
        assert all(count == (1 if large else 2) * int(name.split(".")[0]) for name, count in kept[database].items())
