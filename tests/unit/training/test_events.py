"""The events of a training."""

from dataclasses import FrozenInstanceError, fields, is_dataclass
from typing import get_args

import pytest

from scene_experts.training.events import Event, Finished


def test_every_event_is_frozen_and_says_at_which_step():
    for kind in get_args(Event):
        assert is_dataclass(kind) and "step" in {f.name for f in fields(kind)}, kind
    with pytest.raises(FrozenInstanceError):
        Finished(1, 2.0).step = 3  # type: ignore[misc]
