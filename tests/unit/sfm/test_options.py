"""Settings of a reconstruction."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.sfm.options import MOST_FRAMES, SfmOptions


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        (SfmOptions(frames=2), "--frames"),
        (SfmOptions(frames=MOST_FRAMES + 1), "--frames"),
        (SfmOptions(max_side=10), "--max-side"),
        (SfmOptions(threads=-1), "--threads"),
        (SfmOptions(seed=-1), "--seed"),
        (SfmOptions(seed=2**31), "--seed"),
        (SfmOptions(max_side=2**31), "--max-side"),
        (SfmOptions(threads=2**31), "--threads"),
    ],
)
def test_invalid_settings_name_their_option(options, flag):
    with pytest.raises(InputError, match=flag):
        check_fields(options)


def test_the_defaults_are_valid():
    check_fields(SfmOptions())
