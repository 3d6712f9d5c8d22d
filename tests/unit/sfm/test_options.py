"""Settings of a reconstruction."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.sfm.options import MOST_FRAMES, Options


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        (Options(frames=2), "--frames"),
        (Options(frames=MOST_FRAMES + 1), "--frames"),
        (Options(max_side=10), "--max-side"),
        (Options(threads=-1), "--threads"),
        (Options(seed=-1), "--seed"),
        (Options(seed=2**31), "--seed"),
        (Options(max_side=2**31), "--max-side"),
        (Options(threads=2**31), "--threads"),
    ],
)
def test_invalid_settings_name_their_option(options, flag):
    with pytest.raises(InputError, match=flag):
        options.check()


def test_the_defaults_are_valid():
    Options().check()
