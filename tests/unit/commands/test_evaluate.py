"""`eval` and `compare` from their flags; the scores themselves are tested in test_evaluate_run.py and test_evaluate_tables.py."""

import pytest

from scene_experts.commands.evaluate import compare, evaluate
from scene_experts.core.errors import InputError
from support.messages import naming


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match=naming(tmp_path)):
        evaluate([str(tmp_path), "--no-lpips"])
    with pytest.raises(InputError):
        compare([str(tmp_path)])
