"""The page's list of photographs."""

from dataclasses import replace

from scene_experts.evaluate.photographs import Photograph
from scene_experts.report.photographs import list_photographs
from scene_experts.report.source import read_run
from support.evaluated import make_run


def test_all_have_a_row_and_the_worst_have_pictures(tmp_path):
    source = read_run(make_run(tmp_path))
    text = list_photographs(source, 2)
    assert text.count("<figure>") == 2 and text.count("data:image/jpeg") == 4 and text.count("<tr") == 4
    assert "Evaluate the run again" in text
    code = "<script>alert(1)</script>"
    text = list_photographs(replace(source, photographs=[Photograph(code, "training", "absent.png", 10.0, 20.0, True, "training_views")]))
    assert code not in text and "<figure>" not in text and "class=bad" in text and "Evaluate" not in text
