"""What a reconstruction lacks is told with its reasons and with advice."""

from scene_experts.sfm.lacking import explain_lacking

NOTE = {"photographs": 30, "with_pose": 30, "without_pose": [], "apart": [], "all_compared": False}


def test_a_whole_reconstruction_lacks_nothing():
    assert explain_lacking(NOTE, "--matching exhaustive") == []


def test_reasons_and_advice():
    names = ["a.jpg", "b.jpg", "c.jpg"]
    why = {"a.jpg": "it is blurred", "b.jpg": "it is blurred", "c.jpg": "apart"}
    note = NOTE | {"with_pose": 10, "photographs": 13, "without_pose": names, "why": why, "apart": [3]}
    missing, blurred, apart, parts, more, small = explain_lacking(note, "--matching exhaustive")
    assert all(name in missing for name in names)
    assert blurred.strip() == "a.jpg, b.jpg: it is blurred" and apart.strip() == "c.jpg: apart"
    assert "3" in parts and "--matching exhaustive" in more and "10 photographs" in small
    assert "--matching" not in explain_lacking(note | {"all_compared": True}, "--matching exhaustive")[-2]
