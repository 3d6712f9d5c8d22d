"""All groups together: the table, JSON, and a machine without the compiled library."""

import io
import json

import pytest
from rich.console import Console

from scene_experts.bench import table
from scene_experts.bench.measure import Figure, Missing
from scene_experts.core.errors import InputError, RunError
from scene_experts.native import library as native


def test_sizes_shrink_with_the_budget():
    assert table.choose_size(60) == table.FULL == table.Size(100_000, 800, 544, 40_000)
    assert table.choose_size(10) == table.MEDIUM and table.choose_size(1) == table.SMALL


@pytest.fixture
def no_library(monkeypatch):
    monkeypatch.setattr(native, "find", lambda level: None)
    native.load.cache_clear()
    yield
    native.load.cache_clear()


@pytest.mark.slow
def test_without_the_library_the_report_names_what_is_missing(no_library, tmp_path):
    text, path = io.StringIO(), tmp_path / "b.json"
    with pytest.warns(UserWarning, match="reference"):
        assert table.run(0.5, 1, path, Console(file=text, width=200)) == 0
    printed = text.getvalue()
    assert "reference" in printed
    found = json.loads(path.read_text())
    assert found["machine"]["level"] is None and found["machine"]["multiply_adds"] is None
    assert {m["name"] for m in found["missing"]} >= {"compiled rasteriser", "compiled decode", "fused loss", "gain of threads"}
    assert {"one network in torch", "Top-2 of 5 in torch", "in torch", "whole step"} <= {f["name"] for f in found["figures"]}


def test_a_file_that_cannot_be_written_is_refused_before_measuring(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "measure", None)
    (tmp_path / "file").touch()
    with pytest.raises(RunError, match="another folder with --json"):
        table.run(1, 1, tmp_path / "file" / "b.json", Console(file=io.StringIO()))
    with pytest.raises(InputError, match="add a name"):
        table.run(1, 1, tmp_path, Console(file=io.StringIO()))


def test_the_table_names_the_peer_of_every_ratio():
    text = io.StringIO()
    machine = table.describe(1)
    results = [Figure("parts", "fast", 2.0, "ms", "slow one", 12.5), Missing("parts", "other", "not here")]
    table.print_table(machine, table.SMALL, results, Console(file=text, width=160))
    assert "12.5 x slow one" in text.getvalue() and "not here" in text.getvalue()
    plain = table.convert_to_json(machine, table.SMALL, results, 1.0)
    assert plain["figures"][0]["ratio"] == 12.5 and plain["missing"][0]["why"] == "not here" and json.dumps(plain, allow_nan=False)
