"""The command end to end: a short budget, a table, a JSON file; sentences for what cannot be."""

import json

import pytest

from scene_experts.commands.bench import bench
from scene_experts.core.errors import InputError


def test_a_short_bench_prints_a_table_and_writes_json(capsys, tmp_path):
    out = tmp_path / "figures.json"
    assert bench(["--seconds", "0.5", "--threads", "1", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    assert str(out) in printed
    found = json.loads(out.read_text())
    assert found["machine"]["threads"] == 1 and found["figures"]
    assert all(f["value"] > 0 and f["unit"] for f in found["figures"])
    assert all(f["peer"] for f in found["figures"] if f["ratio"] is not None)


@pytest.mark.parametrize("args", [["--seconds", "0"], ["--seconds", "nan"], ["--threads", "0"], ["--threads", "100000"]])
def test_what_cannot_be_measured_is_one_sentence(args):
    with pytest.raises(InputError, match=args[0]):
        bench(args)
