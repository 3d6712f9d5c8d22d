"""Learning rates of anchors: their fall, factors and ranges."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.scene.anchors.rates import Rates
from support.messages import naming


def test_annealed_rates_fall_from_their_start():
    rates = Rates(anneal=0.1, anneal_from=0.5)
    for group, first in (("feature", 0.0075), ("log_scaling", 0.007), ("cov", 0.004), ("cov.router", 0.004)):
        assert [rates.at(group, step, 1000, 1.0) for step in (1, 500, 750, 1000)] == pytest.approx(
            [first, first, first * 0.1**0.5, first * 0.1]
        )
    assert rates.at("color", 800, 1000, 1.0) == Rates().at("color", 800, 1000, 1.0)  # falls anyway


def test_rates_of_the_networks():
    rates = Rates(networks=3.0, router_scale=0.5)
    assert rates.at("opacity", 1, 1000, 1.0) == pytest.approx(3 * Rates().at("opacity", 1, 1000, 1.0))
    assert rates.at("cov.router", 1, 1000, 1.0) == pytest.approx(1.5 * 0.004)
    assert rates.at("feature", 1, 1000, 1.0) == 0.0075
    for group in ("mix", "appearance"):
        assert rates.at(group, 1, 1000, 1.0) == Rates().at(group, 1, 1000, 1.0) > 0
        assert Rates(networks=0.0).at(group, 1, 1000, 1.0) == 0


@pytest.mark.parametrize("change", [{"anneal": 0.0}, {"anneal": 2.0}, {"anneal_from": 1.0}, {"networks": -1.0}])
def test_invalid_rates(change):
    with pytest.raises(InputError, match=naming(f"--rates.{next(iter(change)).replace('_', '-')}")):
        check_fields(Rates(**change), "rates")
