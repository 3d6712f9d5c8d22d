"""Parametrised tests with a few fast cases, which `make test-fast` runs."""

from collections.abc import Iterable

import pytest


def slow_except(cases: Iterable[str], *fast: str) -> list:
    """The cases for `pytest.mark.parametrize`; every case but `fast` is marked slow."""
    return [case if case in fast else pytest.param(case, marks=pytest.mark.slow) for case in cases]
