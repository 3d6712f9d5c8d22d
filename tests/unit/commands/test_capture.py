"""`scene-experts capture`: its words and its refusals."""

from scene_experts import cli
from scene_experts.commands.capture import told
from support.photos import fake_worker, write_black

NOTE = {
    "with_pose": 3,
    "photographs": 3,
    "without_pose": [],
    "points": 1200,
    "observations": 400.4,
    "error": 0.51,
    "mapper": "global",
    "apart": [],
    "all_compared": True,
    "seconds": 61,
}


def test_what_was_found_and_what_to_do():
    assert told(NOTE) == [
        "3 of 3 photographs have a pose: 1,200 points, 400 seen in a photograph, 0.51 px off on average; global mapper, 1:01 min"
    ]
    few = told({**NOTE, "photographs": 30, "without_pose": [f"{i}.jpg" for i in range(27)], "apart": [2], "all_compared": False})
    assert few[1] == "without a pose: 0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg, 5.jpg, 6.jpg, 7.jpg and 19 more"
    assert "2 of these fit together, but not with the others" in few[2] and "--matching exhaustive --overwrite" in few[3]


def test_a_capture_and_the_next_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("scene_experts.sfm.reconstruct.importlib.util.find_spec", lambda name: name)
    said = {**NOTE, "registered": ["0.jpg", "1.jpg", "2.jpg"], "cameras": []}
    monkeypatch.setattr("scene_experts.sfm.reconstruct.run_worker", fake_worker(**said))
    assert cli.main(["capture", str(write_black(tmp_path / "photos")), "--out", str(tmp_path / "box")]) == 0
    out = capsys.readouterr().out
    assert "3 photographs, 1 camera" in out and f"next: scene-experts train moe-gs --data {tmp_path / 'box'} --out RUN" in out


def test_unusable_input_is_told(tmp_path, capsys):
    folder = str(write_black(tmp_path / "photos"))
    for args, words in [
        ([folder, "--out", folder], "choose another --out"),
        ([folder, "--out", str(tmp_path / "o"), "--max-side", "8"], "expected --max-side of at least 64"),
        ([str(tmp_path / "none"), "--out", str(tmp_path / "o")], "expected a folder of photographs or a video at"),
    ]:
        assert cli.main(["capture", *args]) == 2
        assert words in capsys.readouterr().err
