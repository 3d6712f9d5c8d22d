"""Each way to end badly has its exit code and leaves one line on stderr."""

import errno
import os
from dataclasses import dataclass
from typing import Literal

import pytest

from scene_experts import cli, commands
from scene_experts.core.errors import InputError, RunError, expect_words, few, nearest
from scene_experts.core.reading.source import sentence


@pytest.mark.parametrize(
    ("error", "code", "said"),
    [
        (InputError("expected a, found b; do c"), 2, "error: expected a, found b; do c\n"),
        (RunError("cannot write x: full; free some space"), 1, "error: cannot write x: full; free some space\n"),
        (PermissionError(errno.EACCES, os.strerror(errno.EACCES), "/x"), 1, "/x"),
        (KeyboardInterrupt(), 130, "stopped\n"),
    ],
)
def test_exit_codes(error, code, said, monkeypatch, capsys):
    def fail(*_):
        raise error

    monkeypatch.setattr(commands, "run", fail)
    assert cli.main(["info"]) == code
    out, err = capsys.readouterr()
    assert out == "" and said in err and err.count("\n") == 1


def test_a_command_that_goes_on_says_so_when_it_is_stopped(monkeypatch, capsys):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "run", stop)
    assert cli.main(["capture", "photos"]) == 130
    assert capsys.readouterr().err == "stopped; the same command goes on from there\n"


def test_neither_is_the_other_and_a_fault_of_ours_is_not_hidden(monkeypatch):
    assert not issubclass(InputError, RunError) and not issubclass(RunError, InputError)

    def fault(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(commands, "run", fault)
    with pytest.raises(ZeroDivisionError):
        cli.main(["info"])


def test_a_word_like_a_known_one_is_hinted_at():
    assert nearest("exprt", ["export", "eval"]) == "; did you mean 'export'?"
    assert nearest("zzz", ["export", "eval"]) == ""
    assert nearest("--iteration", ["--resolution", "--iterations"]) == "; did you mean '--iterations'?"  # the other is much less alike
    assert nearest("roma", ["rome", "room", "truck"]) == "; did you mean 'room' or 'rome'?"


@dataclass
class Words:
    text: str = "any"
    order: Literal["up", "down"] = "up"


def test_fields_have_one_of_their_words():
    expect_words(Words())
    for wrong in ("left", ["up"], None):
        with pytest.raises(InputError, match="expected order among up, down, found "):
            expect_words(Words(order=wrong))  # type: ignore[arg-type]


def test_of_many_names_the_first_are_told():
    assert few(["a", "b", "c"]) == "a, b, c" and few(["a", "b", "c", "d"]) == "a, b, c and 1 more" and few([], 8) == ""


def test_a_sentence_shows_on_every_terminal():
    assert sentence("expected a  file") == "expected a  file"
    hostile = sentence("a\nb\x1b]0;title\x07\ud800\u202e" + "x" * 9000)
    assert hostile.isprintable() and len(hostile) <= 2000
