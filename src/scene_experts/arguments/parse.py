"""Parse command-line arguments into a dataclass. All commands use this parser, so they accept and
reject the same syntax."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from scene_experts.arguments.help import format_usage, page, stands_for
from scene_experts.arguments.table import Place, Row, choose_parts, make, rows
from scene_experts.arguments.values import NONE, convert, count, format_value, without_none
from scene_experts.core.errors import InputError, nearest
from scene_experts.core.fields import check_value, flag_of

T = TypeVar("T")
NUMBER = re.compile(r"-(\d|\.\d|inf|nan)")
HELP, HELP_ALL = ("-h", "--help"), "--help-all"


class HelpAsked(Exception):
    """The arguments request help. The help text is the argument of the exception."""


@dataclass(frozen=True)
class Command:
    """Description of a command for `parse`, without its options."""

    name: str
    """As it is typed: "scene-experts eval"."""
    positional: tuple[str, ...] = ()
    """Names of options that may be given without them, in this order: ("run",). Only the last may
    take several values."""
    first: tuple[str, ...] = ()
    """Names of options that --help shows, where --help-all shows the rest too. Empty: all."""
    about: str = ""
    """What the command does; the dataclass's docstring by default."""
    defaults: Mapping[str, Any] = field(default_factory=dict)
    """Values by dotted place that replace the dataclass's own: {"data.normalise": "none"}."""
    elsewhere: Callable[[str], str] = lambda flag: ""
    """Returns a hint for an unknown option: what it belongs to, or an empty string."""

    @property
    def words(self) -> tuple[str, ...]:
        """The flags of `positional`."""
        return tuple(map(flag_of, self.positional))


def parse(kind: type[T], command: Command, args: Sequence[str]) -> T:
    """Parse `args` into an instance of the dataclass `kind`.

    Raises InputError if the arguments are invalid, and HelpAsked for -h, --help and --help-all.
    """
    defaults = choose_parts(kind, command.defaults, lambda row: _word_after(row.flag, args))
    table = rows(kind, defaults)
    if any(arg in HELP or arg == HELP_ALL for arg in args):
        first = () if HELP_ALL in args else tuple(map(flag_of, command.first))
        raise HelpAsked(page(kind, command.name, command.about, table, command.words, first))
    given = _Reader(command, table).read(list(args))
    chosen = {row.place for row in table if row.part is not None}
    missing = [row for row in table if row.required and row.place not in given]
    if missing:
        how = format_usage(command.name, table, command.words)
        raise InputError(f"expected {_both(missing, command)}, found {_none(missing)}; write {how}")
    for row in table:
        if row.place in given:
            check_value(row.owner, row.place[-1], given[row.place], row.flag)
    return make(kind, {place: value for place, value in given.items() if place not in chosen}, defaults)


def _word_after(flag: str, args: Sequence[str]) -> str | None:
    """Return the value that follows an option, or None if it is not given."""
    for i, arg in enumerate(args):
        name, joined, value = arg.partition("=")
        if name.replace("_", "-") == flag:
            return value if joined else next(iter(args[i + 1 : i + 2]), None)
    return None


class _Reader:
    """Reads the arguments in one pass and collects the values of the options."""

    def __init__(self, command: Command, table: Sequence[Row]) -> None:
        self.command = command
        self.by_name = {name: row for row in table for name in row.names}
        self.waiting = [self.by_name[flag] for flag in command.words]
        self.given: dict[Place, Any] = {}
        self.written: dict[Place, str] = {}

    def read(self, args: list[str]) -> dict[Place, Any]:
        while args:
            if is_name(args[0]):
                self._option(args)
            else:
                self._word(args)
        return self.given

    def _option(self, args: list[str]) -> None:
        word = args.pop(0)
        written, joined, value = word.partition("=")
        name = written.replace("_", "-")
        row = self.by_name.get(name)
        if row is None:
            raise InputError(f"expected an option of `{self.command.name}`, found {written}; {self._advice(name)}")
        if row.kind is bool:
            if joined:
                raise InputError(f"expected {written} without a value, found '{word}'; write {row.flag} or {row.negative}")
            self._keep(row, name, name != row.negative)
        else:
            self._keep(row, name, self._value(row, name, [value] if joined else _take(row, args)))

    def _word(self, args: list[str]) -> None:
        if not args[0]:
            raise InputError("expected a value after the command, found an empty one; give one, or leave it out")
        left = [row for row in self.waiting if row.place not in self.given or count(row.kind)[1] is None]
        if not left:
            takes = " ".join(map(stands_for, self.waiting)) or "options"
            raise InputError(f"expected only {takes} after `{self.command.name}`, found also '{args[0]}'; {self._way_out(args[0])}")
        row = left[0]
        before = self.given.pop(row.place, ())  # the values of a list may precede and follow an option
        value = self._value(row, stands_for(row), _take(row, args))
        self._keep(row, stands_for(row), before + value if before else value)

    def _way_out(self, word: str) -> str:
        """What to do with a value too many: a list of files that a shell has made of a pattern has a
        folder."""
        folder = Path(word).parent
        several = Path(word).is_file() and any(
            isinstance(value, Path) and value.is_file() and value.parent == folder for value in self.given.values()
        )
        return f"give the folder {folder}" if several else "leave it out"

    def _value(self, row: Row, name: str, words: list[str]) -> Any:
        if "" in words:
            raise InputError(f"expected a value after {name}, found an empty one; give one, or leave it out")
        default = row.default if row.default not in (MISSING, None, ()) else None
        example = f"{row.flag} {stands_for(row) if default is None else format_value(default)}"
        if not words:
            raise InputError(f"expected a value after {name}, found none; write for example {example}")
        return convert(row.kind, words, name, example)

    def _keep(self, row: Row, name: str, value: Any) -> None:
        if row.place in self.given:
            if not row.option.repeat:
                names = dict.fromkeys((self.written[row.place], name))
                raise InputError(f"expected {row.flag} once, found {' and '.join(names) if len(names) > 1 else 'it twice'}; leave one out")
            value = self.given[row.place] + value
        self.given[row.place], self.written[row.place] = value, name

    def _advice(self, name: str) -> str:
        known = [each for each in self.by_name if each.startswith("--")]
        parts = [each for each in known if each.rpartition(".")[2] == name.removeprefix("--")]  # --top-k for --scene.decoder.top-k
        close = f"did you mean {' or '.join(map(repr, parts[:3]))}?" if parts else nearest(name, known).removeprefix("; ")
        return self._owner(name) or self.command.elsewhere(name) or close or f"`{self.command.name} {HELP_ALL}` lists them"

    def _owner(self, name: str) -> str:
        """Say with which part an option exists that the chosen part does not have."""
        above, _, last = name.rpartition(".")
        row = self.by_name.get(above)
        if row is None or row.part is None:
            return ""
        found = [each for each, kind in row.parts.items() if last.replace("-", "_") in kind.__dataclass_fields__]
        return f"it belongs to {' or '.join(f'{above} {each}' for each in found)}" if found else ""


def is_name(word: str) -> bool:
    """Whether an argument is the name of an option. Negative numbers are values."""
    return len(word) > 1 and word.startswith("-") and not NUMBER.match(word)


def _take(row: Row, args: list[str]) -> list[str]:
    """Remove the values of an option from the front of `args` and return them."""
    most = 1 if row.option.repeat or (args and args[0] in NONE and without_none(row.kind)[1]) else count(row.kind)[1]
    end = next((i for i, word in enumerate(args) if is_name(word)), len(args))
    end = end if most is None else min(end, most)
    words = args[:end]
    del args[:end]
    return words


def _both(missing: Sequence[Row], command: Command) -> str:
    """Return the names of the missing options, for example "--data and --out"."""
    *some, last = [stands_for(row) if row.flag in command.words else row.flag for row in missing]
    return f"{', '.join(some)} and {last}" if some else last


def _none(missing: Sequence[Row]) -> str:
    return ("none", "neither")[len(missing) - 1] if len(missing) < 3 else "none of them"
