"""Arguments as the plain numbers that config.json holds, from Python or NumPy. A run with another value there could not be opened."""

from __future__ import annotations

import math
from numbers import Integral, Real

import numpy as np

from scene_experts.core.errors import InputError


def integer(name: str, value: object, least: int) -> int:
    """Return an integer of at least `least`. Raises InputError, naming the argument, for anything else."""
    if not isinstance(value, Integral) or value < least:
        raise InputError(f"expected {name} as an integer of at least {least}, found {value!r}; correct it")
    return int(value)


def real(name: str, value: object) -> float:
    """Return a finite number as a float. Raises InputError, naming the argument, for anything else."""
    if not isinstance(value, Real) or not math.isfinite(value):
        raise InputError(f"expected {name} as a finite number, found {value!r}; correct it")
    return float(value)


def boolean(name: str, value: object) -> bool:
    """Return True or False. Raises InputError, naming the argument, for anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"expected {name} as True or False, found {value!r}; correct it")
    return bool(value)
