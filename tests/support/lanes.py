"""Parametrised tests of which a few cases are fast and stand for the others in `make test-fast`."""

from collections.abc import Iterable

import pytest


def slow_except(cases: Iterable[str], *fast: str) -> list:
    """The cases for `pytest.mark.parametrize`; every case but `fast` is marked slow."""
    return [case if case in fast else pytest.param(case, marks=pytest.mark.slow) for case in cases]
