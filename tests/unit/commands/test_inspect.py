"""`info` and `doctor` from their flags; what they print is tested where it is made."""

from scene_experts.commands import inspect


def test_info_takes_its_capture_as_first_word_or_flag(monkeypatch):
    seen = []
    monkeypatch.setattr(inspect.run_folder, "load_capture", lambda data, look: seen.append(data.path.name))
    monkeypatch.setattr(inspect, "print_summary", lambda *_: None)
    assert inspect.info(["here/fox"]) == inspect.info(["--data", "here/fox"]) == 0
    assert seen == ["fox", "fox"]
