"""What the page reads of a run folder."""

import json

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.io import write_json
from scene_experts.report.source import find_common_views, group_by_capture, read_run, tell_apart
from support.evaluated import make_run
from support.messages import naming


def test_runs_of_one_capture_are_grouped_and_have_views_in_common(tmp_path):
    sources = [read_run(make_run(tmp_path / "a")), read_run(make_run(tmp_path / "b"))]
    assert list(group_by_capture(sources).values()) == [sources]
    assert [s.name for s in tell_apart(sources)] == ["a (moe-gs)", "b (moe-gs)"]
    names = find_common_views(sources)
    assert names == list(sources[0].per_view) and len(names) > 1
    path = tmp_path / "b" / "per_view.json"
    left = json.loads(path.read_text())
    left.pop(names[0])
    write_json(path, left)
    assert find_common_views([sources[0], read_run(tmp_path / "b")]) == names[1:]


def test_scores_by_view_must_name_files_in_the_run(tmp_path):
    folder = make_run(tmp_path)
    write_json(folder / "per_view.json", {"a": {"file": "../../secret.png", "psnr": 3.0}})
    with pytest.raises(InputError, match=naming("per_view.json")):
        read_run(folder)
