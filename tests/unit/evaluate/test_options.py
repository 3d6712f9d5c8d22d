"""Where an evaluation writes its results."""

from scene_experts.evaluate.options import EvalOptions


def test_each_kind_of_evaluation_has_files_of_its_own():
    kinds = (EvalOptions(), EvalOptions("train"), EvalOptions(appearance="half"))
    assert [(kind.folder, kind.suffix) for kind in kinds] == [("test", ""), ("train", "_train"), ("test_half", "_half")]
