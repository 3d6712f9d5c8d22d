"""Which features and mappers are tried, and which result is kept. `test_reconstruct.py` has the whole call."""

import pytest

from scene_experts.sfm import attempts
from scene_experts.sfm.options import SfmOptions

NAMES = list("abcdefghij")


@pytest.mark.parametrize(
    ("posed", "large", "asked"),
    [
        (10, True, [(3000, "incremental", "db")]),
        (9, True, [(3000, "incremental", "db")]),  # a tenth may lack a pose
        (8, True, [(3000, "incremental", "db"), (None, "auto", "db.all")]),
        (8, False, [(3000, "incremental", "db"), (None, "auto", "db")]),  # no feature was left out: the same serve again
    ],
)
def test_the_smallest_features_come_second_where_poses_are_enough(tmp_path, posed, large, asked):
    requests, said = [], []

    def run(request):
        requests.append(request)
        return {"registered": NAMES[: posed if len(requests) == 1 else 10], "large_features": large}

    (tmp_path / "maps" / "incremental").mkdir(parents=True)
    ask = {"enough": 3000, "mapper": "auto", "groups": [NAMES[:6], NAMES[6:]], "database": "db", "model": str(tmp_path / "model")}
    result, last = attempts.use_own_features(ask, tmp_path / "maps", run, said.append)
    assert [(request["enough"], request["mapper"], request["database"]) for request in requests] == asked
    assert len(result["registered"]) == (10 if len(asked) == 2 else posed) and last["database"] == asked[-1][2]
    assert (tmp_path / "maps").exists() is (len(asked) == 1) and bool(said) is (large and len(asked) == 2)


@pytest.mark.parametrize(
    ("asked", "mapper", "one", "warned"),
    [
        ("auto", "global", False, True),
        ("auto", "global", True, False),
        ("auto", "incremental", False, False),
        ("global", "global", False, False),
    ],
)
def test_the_global_mapper_after_the_other_gets_a_warning(asked, mapper, one, warned):
    result = {"mapper": mapper, **({"one_focal_length": True} if one else {})}
    assert bool(attempts.warn_of_mapper(result, SfmOptions(mapper=asked))) is warned
