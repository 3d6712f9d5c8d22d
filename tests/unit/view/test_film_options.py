"""Options of a film."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.view.film_options import FilmOptions


def test_sizes():
    assert FilmOptions(size="640x360").pixels() == (640, 360) and FilmOptions().pixels() is None
    for wrong in ("640", "640x", "0x10", "1x99999", "-5x5"):
        with pytest.raises(InputError, match="--size"):
            check_fields(FilmOptions(size=wrong))


@pytest.mark.parametrize(
    ("options", "flag"),
    [
        (FilmOptions(quality=11), "--quality"),
        (FilmOptions(seconds=0), "--seconds"),
        (FilmOptions(frames=0), "--frames"),
        (FilmOptions(only=(0,)), "--only"),
    ],
)
def test_invalid_values_name_their_option(options, flag):
    with pytest.raises(InputError, match=flag):
        check_fields(options)
