"""`export` and `import` from their flags; the files themselves are tested in test_export_*.py."""

import pytest

from scene_experts.commands.files import export, import_
from scene_experts.errors import InputError


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(InputError, match="expected a run folder"):
        export([str(tmp_path), "--no-measure"])


def test_a_source_that_is_no_result_is_refused(tmp_path):
    with pytest.raises(InputError):
        import_([str(tmp_path / "nothing"), "--data", str(tmp_path), "--out", str(tmp_path / "run")])
