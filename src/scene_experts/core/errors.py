"""The two ways a command ends badly. Every message says what was expected, what was found and what to do, in one sentence."""

import difflib
from collections.abc import Iterable, Sequence


class InputError(Exception):
    """The user's input (a capture, a run folder, a flag) cannot be used. The command line exits with code 2."""


class RunError(Exception):
    """Something failed while working on good input (a full disk, an interrupted write). The command line exits with code 1."""


def expect_at_least(numbers: list[tuple[str, float, float]]) -> None:
    """Raises InputError for the first (flag, value, least) whose value is below."""
    for flag, value, least in numbers:
        if not value >= least:
            raise InputError(f"expected {flag} of at least {least}, found {value}; give a larger number or leave it out")


def nearest(word: str, words: Iterable[str]) -> str:
    """A hint at the known words most like an unknown one: "; did you mean 'moe-gs'?", or nothing."""
    like = difflib.get_close_matches(word, list(words), 3, 0.6)  # best first
    alike = [difflib.SequenceMatcher(None, found, word).ratio() for found in like]
    close = [found for found, ratio in zip(like, alike) if ratio > alike[0] - 0.05]
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def few(names: Sequence[str], most: int = 3) -> str:
    """The first of many names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
