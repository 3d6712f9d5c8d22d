"""What parts of a training pass back."""

from scene_experts.core.slopes import Regularisers


def test_a_term_that_is_not_named_is_off():
    assert not any(vars(Regularisers()).values())
