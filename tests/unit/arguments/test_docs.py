"""Docstrings of dataclasses and their fields."""

from dataclasses import dataclass

from scene_experts.arguments.docs import explain, of_class, of_field, title


@dataclass
class Told:
    """What it is. More about it.

    A second paragraph.
    """

    size: int = 1
    """How large
    it is."""
    quiet: int = 2


@dataclass
class Below(Told):
    other: int = 3
    """Another one."""


@dataclass
class Bare:
    x: int = 0


def test_the_string_below_a_field_is_its_text():
    assert of_field(Told, "size") == "How large it is." and of_field(Told, "quiet") == ""
    assert of_field(Below, "size") == "How large it is." and of_field(Below, "other") == "Another one."


def test_help_of_a_dataclass_has_its_fields_and_the_command_line_has_not():
    kind = dataclass(type("Told", (), {"__module__": __name__, "__doc__": Told.__doc__, "__annotations__": {"size": int, "quiet": int}}))
    before = of_class(kind)
    explain(kind)
    explain(kind)
    assert kind.__doc__.count("Fields:") == 1 and kind.__doc__.endswith("\n    size: How large it is.") and of_class(kind) == before
    explain(test_the_title_is_the_first_sentence)  # what is no dataclass stays


def test_the_title_is_the_first_sentence():
    assert title(Told) == "What it is" and of_class(Told).endswith("A second paragraph.") and of_class(Bare) == title(Bare) == ""


def test_a_class_without_source_has_no_text():
    space: dict = {"__name__": "nowhere"}
    exec("from dataclasses import dataclass\n@dataclass\nclass Made:\n    x: int = 0\n    'text'\n", space)
    assert of_field(space["Made"], "x") == ""
