"""`scene-experts make`: its options reach the function, and the end says what to open."""

import webbrowser

import pytest

from scene_experts import cli
from scene_experts.making import make as making
from scene_experts.making.make import MadeScene


@pytest.mark.parametrize("scores", [False, True])
def test_the_end_says_what_to_open(tmp_path, monkeypatch, capsys, scores):
    asked, opened, page = {}, [], tmp_path / "scene.html"
    page.write_bytes(b"x" * 1_500_000)

    def make(source, out, *, minutes, scores, options, say, progress):
        asked.update(source=source, out=out, minutes=minutes, scores=scores, nadir=options.nadir)
        report = tmp_path / "report.html" if scores else None
        return MadeScene(page, tmp_path, tmp_path, report, 21.5, {"poses": 0.0, "training": 75.0})

    monkeypatch.setattr(making, "make", make)
    monkeypatch.setattr(webbrowser, "open_new_tab", opened.append)
    args = ["make", str(tmp_path), "--minutes", "3", "--nadir", "20", *(["--scores", "--open"] if scores else [])]
    assert cli.main(args) == 0
    text = capsys.readouterr().out
    assert asked == {"source": tmp_path, "out": None, "minutes": 3.0, "scores": scores, "nadir": 20.0}
    assert f"open {page}" in text and "1.5 MB" in text and "training 1:15" in text and "21.50 dB" in text
    assert ("held out" in text) is scores and ("report" in text) is scores and opened == [page.as_uri()] * scores
