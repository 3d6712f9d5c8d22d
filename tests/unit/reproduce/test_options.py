"""Options of a reproduction."""

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import check_fields
from scene_experts.reproduce.options import ReproduceOptions


@pytest.mark.parametrize(("given", "workers"), [({}, 1), ({"devices": ("0", "1")}, 2), ({"devices": ("0", "1"), "workers": 1}, 1)])
def test_every_device_has_a_worker_unless_told_otherwise(given, workers):
    assert ReproduceOptions(("table3",), **given).worker_count == workers


@pytest.mark.parametrize(("given", "flag"), [({"workers": 0}, "--workers"), ({"seeds": (0, -1)}, "--seeds")])
def test_invalid_values_name_their_option(given, flag):
    with pytest.raises(InputError, match=flag):
        check_fields(ReproduceOptions(("table3",), **given))


def test_options_of_a_cluster():
    assert ReproduceOptions(("table3",), cluster="tcp://a:1", resources=("GPU=1", "MEMORY=2.5")).needs() == {"GPU": 1, "MEMORY": 2.5}
    for given, flag in (
        ({"cluster": "tcp://a:1", "workers": 2}, "--workers"),
        ({"cluster": "tcp://a:1", "devices": ("0",)}, "--devices"),
        ({"resources": ("GPU=1",)}, "--cluster"),
        *(({"cluster": "tcp://a:1", "resources": (text,)}, "--resources") for text in ("GPU", "GPU=0", "=1", "GPU=many", "GPU=nan")),
    ):
        with pytest.raises(InputError, match=flag):
            check_fields(ReproduceOptions(("table3",), **given))
