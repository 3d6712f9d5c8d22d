"""Rows to columns and back, and the text of a record."""

import json

import pytest

from scene_experts.reproduce.columns import columns, length, rows, text

EXAMPLES = [
    [],
    [{"step": 1, "routing": {"cov": [0.5, 0.5]}}, {"step": 2, "routing": {"cov": [0.1, 0.9]}}],
    [{"step": 1, "routing": {}}, {"step": 2, "routing": {}}],  # a method without experts
    [{"step": 1}, {"step": 2, "scene_routing": {}}],  # resumed by a later version, which logs more
    [{"step": 1, "routing": {"cov": [1.0]}}, {"step": 2, "routing": {}}],
]


@pytest.mark.parametrize("example", EXAMPLES)
def test_columns_lose_nothing(example):
    made = json.loads(text(columns(example)))
    assert json.dumps(rows(made, length(made))) == json.dumps(example)


def test_like_rows_share_their_keys():
    assert columns(EXAMPLES[1]) == {"step": [1, 2], "routing": {"cov": [[0.5, 0.5], [0.1, 0.9]]}}
    assert columns(EXAMPLES[3]) is EXAMPLES[3]


def test_text_has_a_line_for_each_entry_and_refuses_nan():
    assert text({"a": {"b": {"c": [1, 2]}, "d": 0.1}, "e": {}}) == '{\n"a":{\n"b":{"c":[1,2]},\n"d":0.1\n},\n"e":{}\n}'
    with pytest.raises(ValueError, match="JSON"):
        text({"psnr": float("nan")})
