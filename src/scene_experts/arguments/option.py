"""Annotation that describes the command-line option of a dataclass field."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Option:
    """Annotation of a dataclass field, for example `out: Annotated[Path, Option(short="-m",
    value="RUN")]`.

    The name of an option defaults to the name of the field: `max_views` becomes `--max-views`.
    """

    name: str | None = None
    """Name of the option without dashes. An empty name on a field that holds a dataclass leaves out
    the prefix of its options."""
    short: str = ""
    """A second, one-letter name with its dash."""
    value: str = ""
    """What stands for the value in the help, for example CAPTURE."""
    hidden: bool = False
    """The field is no option: it keeps its default."""
    repeat: bool = False
    """A tuple that takes one value each time the option is given, instead of several values after
    one option."""
