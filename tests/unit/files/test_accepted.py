"""Options of an export that are accepted: ranges, and what a format cannot use."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.files.accepted import check_values, expect_unused
from scene_experts.files.options import DEFAULT, Options
from support.messages import naming


@pytest.mark.parametrize("name", ["sh_degree", "max_gaussians", "refine"])
def test_numbers_out_of_range_are_named_by_their_flag(name):
    with pytest.raises(InputError, match=naming("--" + name.replace("_", "-"), -1)):
        check_values(Options(**{name: -1}))
    check_values(DEFAULT)
    with pytest.raises(InputError, match=naming("--sh-degree", 4)):
        check_values(Options(sh_degree=4))
    for prune in (1.0, -0.1, float("nan")):
        with pytest.raises(InputError, match="--prune"):
            check_values(Options(prune=prune))


def test_options_of_standard_files_are_not_ignored_elsewhere():
    for options in (DEFAULT, Options(measure=False)):
        expect_unused(options, "compact")
    for name, value in {"levels": True, "frame": "trained", "prune": 0.1}.items():
        with pytest.raises(InputError, match=naming(f"--{name}", "compact")):
            expect_unused(Options(**{name: value}), "compact")


def test_a_precision_is_for_compact_files_and_in_range():
    for options in (Options(quality=0.1), Options(target_mb=1.5)):
        check_values(options)
        expect_unused(options, "compact")
        with pytest.raises(InputError, match=naming("--format compact", "anchors")):
            expect_unused(options, "anchors")
    for name, values in {"quality": (0.0, -1.0, float("nan"), float("inf")), "target_mb": (-1.0, float("nan"), float("inf"))}.items():
        for value in values:
            with pytest.raises(InputError, match=naming("--" + name.replace("_", "-"))):
                check_values(Options(**{name: value}))
    with pytest.raises(InputError, match=naming("--quality", "--target-mb")):
        check_values(Options(quality=0.1, target_mb=1.0))
