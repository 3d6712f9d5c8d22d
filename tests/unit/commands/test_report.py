"""`scene-experts report` from its flags."""

from scene_experts import cli
from support.evaluated import make_run


def test_the_page_is_where_it_was_asked_for(tmp_path, capsys):
    make_run(tmp_path / "a")
    assert cli.main(["report", str(tmp_path / "a"), "--out", str(tmp_path / "page.html")]) == 0
    assert (tmp_path / "page.html").read_text().startswith("<!doctype html>")
    assert cli.main(["report", str(tmp_path)]) == 2
