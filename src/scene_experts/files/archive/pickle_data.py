"""A pickle read as data: its values are rebuilt as inert trees, nothing it names is imported,
called or constructed.

A pickle is a program for a stack machine. The one here knows only the operations that describe
data, and answers "make an object" and "call this" with a record of the names and arguments. Who
reads the tree decides what such a record means. Python's own unpickler is not used.
"""

from __future__ import annotations

import pickletools
from dataclasses import dataclass, field
from typing import Any

SIZE_LIMIT = 64 << 20  # bytes of pickle; network files have a few thousand


class NotData(ValueError):
    """The bytes are no pickle, a damaged one, or one that does more than describe data."""


@dataclass(frozen=True)
class Global:
    """The name of a class or function. Only the name."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(eq=False)
class Record:
    """An object that was not made: what to make or call, with which arguments, and what would then
    be put into it."""

    what: Global
    args: tuple[Any, ...]
    items: dict[Any, Any] = field(default_factory=dict)
    state: Any = None


@dataclass(frozen=True)
class Outside:
    """A reference to something kept outside the pickle (a storage of tensor bytes)."""

    key: Any


_MARK = object()
_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY = {"EMPTY_DICT": dict, "EMPTY_LIST": list}
_LITERALS = {
    "BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1", "BINFLOAT", "FLOAT",
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "UNICODE", "STRING", "BINSTRING", "SHORT_BINSTRING",
}  # fmt: skip
_FIXED = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def decode(data: bytes) -> Any:
    """The value of a pickle as dicts, lists, tuples, numbers and texts, with `Record`, `Global` and
    `Outside` for the rest.

    Raises NotData.
    """
    if len(data) > SIZE_LIMIT:
        raise NotData(f"it has {len(data):,} bytes")
    machine = _Machine()
    try:
        for opcode, argument, _ in pickletools.genops(data):
            if opcode.name == "STOP":
                return machine.pop()
            machine.step(opcode.name, argument)
    except NotData:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError, RecursionError) as error:
        raise NotData(f"it is damaged: {error}") from None
    raise NotData("it has no end")


class _Machine:
    """The stack and memo of the decoder."""

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.memo: dict[int, Any] = {}

    def pop(self) -> Any:
        if not self.stack or self.stack[-1] is _MARK:
            raise NotData("it is damaged: its stack is empty")
        return self.stack.pop()

    def since_mark(self) -> list[Any]:
        at = max(i for i, value in enumerate(self.stack) if value is _MARK)
        values = self.stack[at + 1 :]
        del self.stack[at:]
        return values

    def take(self, count: int) -> list[Any]:
        return [self.pop() for _ in range(count)][::-1]

    def step(self, name: str, argument: Any) -> None:
        push = self.stack.append
        match name:
            case "PROTO" | "FRAME":
                pass
            case _ if name in _CONSTANTS:
                push(_CONSTANTS[name])
            case _ if name in _LITERALS:
                push(argument)
            case _ if name in _EMPTY:
                push(_EMPTY[name]())
            case _ if name in _FIXED:
                push(tuple(self.take(_FIXED[name])))
            case "MARK":
                push(_MARK)
            case "TUPLE":
                push(tuple(self.since_mark()))
            case "LIST":
                push(self.since_mark())
            case "APPEND" | "APPENDS":
                values = self.since_mark() if name == "APPENDS" else self.take(1)
                _kind(self.stack[-1], list).extend(values)
            case "DICT":
                push(dict(_pairs(self.since_mark())))
            case "SETITEM" | "SETITEMS":
                values = self.since_mark() if name == "SETITEMS" else self.take(2)
                into = self.stack[-1]
                _kind(into.items if isinstance(into, Record) else into, dict).update(_pairs(values))
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                self.memo[argument] = self.stack[-1]
            case "MEMOIZE":
                self.memo[len(self.memo)] = self.stack[-1]
            case "GET" | "BINGET" | "LONG_BINGET":
                push(self.memo[argument])
            case "POP":
                self.pop()
            case _:
                self.describe(name, argument)

    def describe(self, name: str, argument: Any) -> None:
        """The operations that in Python would import, construct or call: here they write down names
        and arguments."""
        match name:
            case "GLOBAL":
                module, _, member = argument.partition(" ")
                self.stack.append(Global(module, member))
            case "STACK_GLOBAL":
                module, member = self.take(2)
                self.stack.append(Global(_kind(module, str), _kind(member, str)))
            case "NEWOBJ" | "REDUCE":
                what, args = self.take(2)
                self.stack.append(Record(_kind(what, Global), _kind(args, tuple)))
            case "BUILD":
                (state,) = self.take(1)
                _kind(self.stack[-1], Record).state = state
            case "BINPERSID":
                self.stack.append(Outside(self.pop()))
            case _:
                raise NotData(f"it uses the operation {name}, which plain data has no need of")


def _kind(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise NotData(f"it is damaged: {kind.__name__} expected where it has {type(value).__name__}")
    return value


def _pairs(values: list[Any]) -> list[tuple[Any, Any]]:
    if len(values) % 2:
        raise NotData("it is damaged: a key without a value")
    return list(zip(values[::2], values[1::2]))
