"""The two errors that end a command. Each message states in one sentence what was expected, what
was found and what to do."""

import difflib
from collections.abc import Iterable, Sequence
from typing import Any, Literal, get_args, get_origin, get_type_hints


class InputError(Exception):
    """The user's input (a capture, a run folder, a flag) cannot be used. The command line exits
    with code 2."""


class RunError(Exception):
    """Something failed while working on good input (a full disk, an interrupted write). The command
    line exits with code 1."""


def expect_among(name: str, value: object, words: Iterable[str]) -> None:
    """Raise InputError unless the value of the argument `name` is one of `words`."""
    known = tuple(words)
    if not isinstance(value, str) or value not in known:
        raise InputError(f"expected {name} among {', '.join(known)}, found {value!r}; choose one of those")


def expect_words(options: Any) -> None:
    """Raise InputError for the first Literal field of a dataclass whose value is not one of its
    words."""
    for name, kind in get_type_hints(type(options)).items():
        if get_origin(kind) is Literal:
            expect_among(name, getattr(options, name), get_args(kind))


def nearest(word: str, words: Iterable[str]) -> str:
    """Return a hint with the known words closest to `word`, for example "; did you mean 'moe-gs'?",
    or an empty string."""
    like = difflib.get_close_matches(word, list(words), 3, 0.6)  # best first
    alike = [difflib.SequenceMatcher(None, found, word).ratio() for found in like]
    close = [found for found, ratio in zip(like, alike) if ratio > alike[0] - 0.05]
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def few(names: Sequence[str], most: int = 3) -> str:
    """Return the first `most` names, joined by commas, and the number of the remaining names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
