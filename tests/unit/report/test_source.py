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


def test_captures_of_one_name_with_other_poses_are_two_groups(tmp_path):
    sources = []
    for name, x in (("a", 1.0), ("b", 2.0), ("c", 1.0)):
        folder = make_run(tmp_path / name)
        results = json.loads((folder / "results.json").read_text())
        write_json(folder / "results.json", {**results, "poses": f"{x} 0 0 1 0 0 0 1 0; 0 1 0 1 0 0 0 1 0"})
        sources.append(read_run(folder))
    name = sources[0].results["capture"]
    assert group_by_capture(sources) == {name: [sources[0], sources[2]], f"{name} (2)": [sources[1]]}


def test_scores_by_view_must_name_files_in_the_run(tmp_path):
    folder = make_run(tmp_path)
    write_json(folder / "per_view.json", {"a": {"file": "../../secret.png", "psnr": 3.0}})
    with pytest.raises(InputError, match=naming("per_view.json")):
        read_run(folder)
