"""Convert the words of a command line to values."""

from pathlib import Path
from typing import Literal

import pytest

from scene_experts.arguments.values import convert, count, describe, format_value, placeholder
from scene_experts.core.errors import InputError

TRIPLE = tuple[float, float, float]


@pytest.mark.parametrize(
    ("kind", "words", "value"),
    [
        (int, ["-3"], -3),
        (float, ["1e-3"], 0.001),
        (str, ["none"], "none"),
        (str | None, ["none"], None),
        (int | None, ["4"], 4),
        (Path, ["a/b"], Path("a/b")),
        (Literal["a", "b"], ["b"], "b"),
        (Literal[1, 2], ["2"], 2),
        (tuple[int, ...], ["1", "2", "3"], (1, 2, 3)),
        (tuple[Literal["x", "y"], ...], ["y"], ("y",)),
        (tuple[str, ...], ["none"], ()),
        (TRIPLE, ["0", "0.5", "1"], (0.0, 0.5, 1.0)),
        (TRIPLE | None, ["None"], None),
    ],
)
def test_what_fits(kind, words, value):
    assert convert(kind, words, "--flag", "--flag ...") == value


@pytest.mark.parametrize(
    ("kind", "words", "facts"),
    [
        (int, ["abc"], ("a whole number", "'abc'", "--flag 7")),
        (int, ["1.5"], ("a whole number", "'1.5'")),
        (float, ["1,5"], ("a number", "'1,5'")),
        (Literal["auto", "cpu", "cuda"], ["gpu"], ("auto, cpu or cuda", "'gpu'")),
        (Literal["one", "two", "three", "four", "five"], ["thre"], ("did you mean 'three'",)),
        (tuple[int, ...], ["1", "x"], ("a whole number", "'x'")),
        (TRIPLE, ["1", "2"], ("3 values", "found 2")),
    ],
)
def test_what_does_not_fit_is_named(kind, words, facts):
    with pytest.raises(InputError) as error:
        convert(kind, words, "--flag", "--flag 7")
    assert "--flag" in str(error.value) and all(fact in str(error.value) for fact in facts)


def test_how_many_words_a_value_takes():
    kinds = (bool, int, int | None, tuple[int, ...], TRIPLE, TRIPLE | None)
    assert [count(kind) for kind in kinds] == [(0, 0), (1, 1), (1, 1), (1, None), (3, 3), (1, 3)]


def test_how_types_and_values_are_written():
    assert [placeholder(kind) for kind in (int, Literal["a", "b"], tuple[Path, ...], TRIPLE, bool)] == ["N", "a|b", "PATH ...", "X X X", ""]
    assert placeholder(tuple[Path, ...], "RUN") == "RUN ..." and describe(int | None) == "a whole number"
    assert [format_value(value) for value in (None, 0.1, 1e-7, ("a", "b"), 30000)] == ["none", "0.1", "1e-07", "a b", "30000"]


def test_a_type_without_words_is_a_fault_of_the_program():
    with pytest.raises(TypeError):
        count(int | str)
