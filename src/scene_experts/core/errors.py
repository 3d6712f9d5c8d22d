"""The two errors that end a command. Each message states in one sentence what was expected, what was found and what to do."""

import difflib
from collections.abc import Iterable, Sequence


class InputError(Exception):
    """The user's input (a capture, a run folder, a flag) cannot be used. The command line exits with code 2."""


class RunError(Exception):
    """Something failed while working on good input (a full disk, an interrupted write). The command line exits with code 1."""


def expect_at_least(numbers: list[tuple[str, float, float]]) -> None:
    """Raise InputError for the first (flag, value, least) whose value is below `least` or NaN."""
    for flag, value, least in numbers:
        if not value >= least:
            raise InputError(f"expected {flag} of at least {least}, found {value}; give a larger number or leave it out")


def nearest(word: str, words: Iterable[str]) -> str:
    """Return a hint with the known words closest to `word`, for example "; did you mean 'moe-gs'?", or an empty string."""
    like = difflib.get_close_matches(word, list(words), 3, 0.6)  # best first
    alike = [difflib.SequenceMatcher(None, found, word).ratio() for found in like]
    close = [found for found, ratio in zip(like, alike) if ratio > alike[0] - 0.05]
    return f"; did you mean {' or '.join(map(repr, close))}?" if close else ""


def few(names: Sequence[str], most: int = 3) -> str:
    """Return the first `most` names, joined by commas, and the number of the remaining names."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
