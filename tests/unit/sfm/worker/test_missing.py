"""Why a photograph has no pose."""

from scene_experts.sfm.worker import missing


def test_why_a_photograph_has_no_pose():
    posed = {1, 2}
    words = [
        missing.explain(30, {1: 90}, posed, False),
        missing.explain(3000, {1: 90}, posed, True),
        missing.explain(3000, {1: 0}, posed, False),
        missing.explain(3000, {3: 40}, posed, False),
        missing.explain(3000, {1: 40, 2: 20, 3: 99}, posed, False),
    ]
    assert len(set(words)) == 5 and "30 features" in words[0] and "2 photographs" in words[4] and "at most 40" in words[4]
