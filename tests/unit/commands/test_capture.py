"""`scene-experts capture`: its words and its refusals."""

from scene_experts import cli
from scene_experts.commands.capture import summarise
from scene_experts.training.recipes import PROPOSED
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
    line, advice = summarise(NOTE)
    assert all(fact in line for fact in ("3 of 3", "1,200", "400", "0.51 px", "global", "1:01"))
    assert "take 30 or more" in advice and len(summarise({**NOTE, "with_pose": 12, "photographs": 12})) == 1
    few = summarise({**NOTE, "photographs": 30, "without_pose": [f"{i}.jpg" for i in range(27)], "apart": [2], "all_compared": False})
    assert "0.jpg, 1.jpg, 2.jpg, 3.jpg, 4.jpg, 5.jpg, 6.jpg, 7.jpg" in few[1] and "19" in few[1] and "8.jpg" not in few[1]
    assert "2" in few[2] and "--matching exhaustive --overwrite" in few[3]


def test_why_a_second_mapper_ran_and_why_photographs_have_no_pose():
    tried = {"mappers": {"incremental": 2, "global": 3}, "without_pose": ["a.jpg"], "why": {"a.jpg": "it is blurred"}}
    lines = summarise({**NOTE, **tried, "photographs": 4})
    assert "2 from the incremental mapper and 3 from the global mapper" in lines[1] and lines[3].strip() == "a.jpg: it is blurred"


def test_a_capture_and_the_next_command(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("scene_experts.sfm.reconstruct.importlib.util.find_spec", lambda name: name)
    said = {**NOTE, "registered": ["0.jpg", "1.jpg", "2.jpg"], "cameras": []}
    monkeypatch.setattr("scene_experts.sfm.reconstruct.run_worker", fake_worker(**said))
    assert cli.main(["capture", str(write_black(tmp_path / "photos")), "--out", str(tmp_path / "box")]) == 0
    out = capsys.readouterr().out
    assert "3 photographs" in out and f"scene-experts train {PROPOSED} --data {tmp_path / 'box'} --out RUN" in out and "--model" not in out
    (tmp_path / "box/sparse/1").mkdir()
    (tmp_path / "box/sparse/1/images.txt").write_text("")
    assert cli.main(["capture", str(tmp_path / "photos"), "--out", str(tmp_path / "box"), "--overwrite"]) == 0
    out = capsys.readouterr().out
    assert (
        "also holds 1 of another reconstruction" in out and "--model sparse/0" in out and (tmp_path / "box/sparse/1/images.txt").is_file()
    )


def test_unusable_input_is_told(tmp_path, capsys):
    folder = str(write_black(tmp_path / "photos"))
    for args, fact in [
        ([folder, "--out", folder], "--out"),
        ([folder, "--out", str(tmp_path / "o"), "--max-side", "8"], "--max-side"),
        ([str(tmp_path / "none"), "--out", str(tmp_path / "o")], str(tmp_path / "none")),
    ]:
        assert cli.main(["capture", *args]) == 2
        assert fact in capsys.readouterr().err
