"""An Option says of a field what its name and type do not."""

from scene_experts.arguments.option import Option


def test_a_field_without_one_is_an_ordinary_option():
    plain = Option()
    assert plain.name is None and not (plain.short or plain.value or plain.hidden or plain.repeat)
