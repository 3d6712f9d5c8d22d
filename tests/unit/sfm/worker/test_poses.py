"""Which mapper runs, and whose result is kept."""

import json

import pytest

from scene_experts.sfm.worker import poses


class Image:
    def __init__(self, name):
        self.name = name


class Model:
    """A stand-in for a reconstruction of the photographs `names`."""

    def __init__(self, names, written):
        self.images, self.cameras, self.written = {i: Image(name) for i, name in enumerate(names)}, {}, written

    def num_reg_images(self):
        return len(self.images)

    def num_points3D(self):
        return 10 * len(self.images)

    def write_binary(self, folder):
        self.written.append("".join(image.name for image in self.images.values()))

    def reg_image_ids(self):
        return list(self.images)

    def compute_mean_reprojection_error(self):
        return 0.5

    compute_mean_observations_per_reg_image = compute_mean_reprojection_error


@pytest.fixture
def reconstruct(tmp_path, monkeypatch):
    """Return a function that runs the mappers with given results and returns which ran and what was written. None: the mapper fails."""
    calls = []

    def reconstructed(incremental, at_once, mapper="auto"):
        ran, written = [], []

        def mapping(name, models):
            def run(colmap, ask, out, total):
                ran.append(name)
                if models is None:
                    raise RuntimeError("no good pair")
                return {i: Model(names, written) for i, names in enumerate(models)}

            return run

        calls.append(None)
        monkeypatch.setattr(poses, "MAPPERS", {"incremental": mapping("incremental", incremental), "global": mapping("global", at_once)})
        monkeypatch.setattr(poses, "explain_missing", lambda *_: {})
        folder = tmp_path / str(len(calls))
        ask = {"maps": str(folder / "maps"), "model": str(folder / "model"), "groups": [list("abcdefghij")], "mapper": mapper}
        return ran, written, poses.estimate_poses(None, ask)

    return reconstructed


def test_the_second_mapper_is_tried_if_the_first_leaves_many_out(reconstruct, capsys):
    ran, written, found = reconstruct(["abcdefghi", "abj"], ["abcdefghij"])
    assert ran == ["incremental"] and written == ["abcdefghi"] and found["registered"] == list("abcdefghi")
    assert found["apart"] == [1]  # only j of the second model is in no other model
    ran, written, found = reconstruct(["abcd"], ["abcdefg"])
    assert ran == ["incremental", "global"] and written == ["abcdefg"] and found["mapper"] == "global" and found["apart"] == []
    assert found["mappers"] == {"incremental": 4, "global": 7} and found["lacking"] == list("efghij")
    assert json.loads(capsys.readouterr().out.splitlines()[-2])["posed"] == 4  # said before the second mapper starts
    ran, written, found = reconstruct(["abcd"], None)
    assert written == ["abcd"] and found["mapper"] == "incremental"
    ran, written, found = reconstruct([], [], mapper="global")
    assert ran == ["global"] and not written and found == {"registered": [], "lacking": list("abcdefghij")}
