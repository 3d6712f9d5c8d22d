"""The numbers by which docs/compact-file.md lets a reader be checked are those of the reference."""

import re
from pathlib import Path

import numpy as np

from scene_experts.files.codec import reference
from scene_experts.files.codec.streams import SymbolReader

PAGE = Path("docs/compact-file.md").read_text().split("## To check a reader")[1].split("\n## ")[0]
LINES = [line.split("|")[2] for line in PAGE.splitlines() if line.startswith("| ")]
ROWS = [[int(n) for n in re.findall(r"(?<![\w^(])-?\d+(?!\^)", line)] for line in LINES[1:]]


def numbers(*found):
    return np.array(found, np.int32)


def test_the_table():
    powers, zeros, first, second, predicted, inputs = ROWS
    assert powers == [reference.power(1 << 26), *(reference.tail(u) for u in (0, 3 << 24, 1 << 26))]
    assert zeros == [n for odds in (40, 64, 127) for n in (0, reference.zeros(odds))]
    for row, of in ((first, (32, 4)), (second, (20, 7))):
        assert row == [reference.table(*of)[e] for e in (0, 1, 39, 40, 41, 81)]
    given = np.array([[32], [-5]], np.int16), np.array([[3, -7], [1, 2]], np.int8)
    assert predicted == [int(v[0]) for v in reference.predict(*given, (1000, 3, -40, 2), np.array([-1], np.int8))]
    assert inputs == reference.as_inputs(numbers(37, -2000), np.array([1, -2], np.int8), 700, 123456).tolist()


def test_the_streams():
    streams = [bytes.fromhex(found) for found in re.findall(r"`([0-9a-f]{20,})`", PAGE)]
    text = " ".join(PAGE.split())
    means, scales, values = (
        numbers(*map(int, re.findall(r"-?\d+", re.search(pattern, text)[1])))  # type: ignore[index]
        for pattern in (r"the means ([-\d, ]+)", r"the scales ([-\d, ]+):", r"the scales [-\d, ]+: ([-\d, ]+)")
    )
    for slow in (False, True):
        reader = SymbolReader(streams[0], slow)
        assert reader.symbols(means, scales).tolist() == values.tolist() and len(values) == 7
        assert reader.bits(numbers(64, 40, 90)).tolist() == [1, 0, 1]
        reader.finish()
        reader = SymbolReader(streams[1], slow)
        assert reader.cells(2, 6).tolist() == [0, 1, 3, 30, 50, 63]
        reader.finish()
