"""What a dataclass field says about its command-line option."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Option:
    """Annotation of a dataclass field, as in `out: Annotated[Path, Option(short="-m", value="RUN")]`.

    A field without it becomes the option that its name spells: `max_views` is `--max-views`.
    """

    name: str | None = None
    """Name of the option without dashes. An empty name on a field that holds a dataclass leaves out the prefix of its options."""
    short: str = ""
    """A second, one-letter name with its dash."""
    value: str = ""
    """What stands for the value in the help, for example CAPTURE."""
    hidden: bool = False
    """The field is no option: it keeps its default."""
    repeat: bool = False
    """A tuple that takes one value each time the option is given, instead of several values after one option."""
