"""`info` and `doctor` from their words."""

from scene_experts.commands import inspect
from support.synthetic import make_capture


def test_info_takes_its_capture_as_first_word_or_option(tmp_path, capsys):
    capture = str(make_capture(tmp_path, views=4, size=(24, 16), points=60).folder)
    for args in ([capture], ["--data", capture], ["--split", "none", capture]):
        assert inspect.info(args) == 0 and "4" in capsys.readouterr().out
