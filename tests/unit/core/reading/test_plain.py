"""JSON, lines and literals: plain values within limits."""

import json
import math

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Budget, Damaged
from scene_experts.core.reading.plain import check_plain, parse_json, parse_literal, parse_namespace, read_json, read_json_lines
from support.messages import naming

BAD = ["[" * 100_000, "1" * 5000, "[NaN]", "[1e999]", "[-Infinity]", "1" * 30, "[" * 40 + "]" * 40, "{", "\ud800"]


@pytest.mark.parametrize("text", BAD, ids=range(len(BAD)))
def test_values_that_are_refused(tmp_path, text):
    with pytest.raises((ValueError, RecursionError)):
        parse_json(text)
    (tmp_path / "a.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(InputError, match=naming("a.json", "camera path")):
        read_json(tmp_path / "a.json", "camera path")


def test_values_that_are_read(tmp_path):
    value = {"a": [1, 2.5, None, True, "x", {"b": [2**63 - 1]}]}
    (tmp_path / "a.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(value).encode())
    assert read_json(tmp_path / "a.json", "x") == value
    with pytest.raises(InputError, match="no such file"):
        read_json(tmp_path / "b.json", "x")
    assert math.isnan(parse_json("[NaN]", finite=False)[0])


def test_limits_of_items_and_depth():
    small = Budget("x", 100, items=10, depth=3)
    check_plain([[[1]]], small)
    with pytest.raises(Damaged, match="deep"):
        check_plain([[[[1]]]], small)
    with pytest.raises(Damaged, match="10"):
        check_plain(list(range(10)), small)
    with pytest.raises(Damaged, match="100"):
        parse_json(" " * 101, small)


def test_lines_that_are_not_objects_are_skipped(tmp_path):
    (tmp_path / "m").write_bytes(b'{"step": 1}\n\xff\n{"st\n[1]\n' + b"[" * 200_000 + b'\n{"step": NaN}\n')
    found = list(read_json_lines(tmp_path / "m"))
    assert found[0] == {"step": 1} and math.isnan(found[1]["step"]) and len(found) == 2


def test_namespaces():
    text = "Namespace(a=1, b='x, y)', c=[1, (2, 3)], d=PosixPath('/x'), e=-0.5, f=None, g=print(1), h=1+2, i={'k': True})"
    assert parse_namespace(text) == {"a": 1, "b": "x, y)", "c": [1, (2, 3)], "e": -0.5, "f": None, "i": {"k": True}}
    assert parse_namespace("Namespace()") == {}
    for bad in ("Namespace(", "other(a=1)", "Namespace(1)", "Namespace(a=[)", "Namespace(a='x)", "Namespace(a=1)(b=2)"):
        with pytest.raises(Damaged):
            parse_namespace(bad)


LEFT_OUT = [
    "-" * 100_000 + "1",
    "(" * 5000 + ")" * 5000,
    "not " * 1000 + "1",
    "1e999",
    "9" * 5000,
    "[" * 150 + "]" * 150,
    "a.b",
    "lambda: 0",
]


@pytest.mark.parametrize("text", LEFT_OUT, ids=range(len(LEFT_OUT)))
def test_literals_that_are_left_out(text):
    assert parse_literal(text) == (None, False)
