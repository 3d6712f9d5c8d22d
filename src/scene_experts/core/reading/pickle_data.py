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

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.reading.source import shorten

SIZE_LIMIT = 16 << 20  # bytes of pickle; network files have a few thousand
STEP_LIMIT = 200_000  # operations of a pickle; network files have a few thousand
DEPTH_LIMIT = 50
KEY_LIMIT = 256  # characters of a name
_KEYS = (str, int, float, bool, type(None))


class NotData(Damaged):
    """The bytes are no pickle, a damaged one, or one that does more than describe data."""


@dataclass(frozen=True)
class Global:
    """The name of a class or function. Only the name."""

    module: str
    name: str

    def __str__(self) -> str:
        return f"{self.module}.{self.name}"


@dataclass(eq=False)
class ObjectRecord:
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


_CONSTANTS = {"NONE": None, "NEWTRUE": True, "NEWFALSE": False}
_EMPTY = {"EMPTY_DICT": dict, "EMPTY_LIST": list}
_LITERALS = {
    "BININT", "BININT1", "BININT2", "INT", "LONG", "LONG1", "BINFLOAT", "FLOAT",
    "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8", "UNICODE", "STRING", "BINSTRING", "SHORT_BINSTRING",
}  # fmt: skip
_FIXED = {"EMPTY_TUPLE": 0, "TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}


def decode(data: bytes) -> Any:
    """The value of a pickle as dicts, lists, tuples, numbers and texts, with `ObjectRecord`,
    `Global` and `Outside` for the rest.

    Raises NotData.
    """
    if len(data) > SIZE_LIMIT:
        raise NotData(f"it has {len(data):,} bytes")
    machine = _Machine()
    try:
        for count, (opcode, argument, _) in enumerate(pickletools.genops(data)):
            if opcode.name == "STOP":
                return machine.pop()
            if count > STEP_LIMIT:
                raise NotData(f"it has more than {STEP_LIMIT:,} steps")
            machine.step(opcode.name, argument)
    except NotData:
        raise
    except (ValueError, TypeError, LookupError, AttributeError, OverflowError, MemoryError, RecursionError) as error:
        raise NotData(f"it is damaged: {shorten(str(error))}") from None
    raise NotData("it has no end")


class _Machine:
    """The stack and memo of the decoder. `deep` has the nesting of every value on the stack,
    `marks` the places of the marks.

    Values are nested at most DEPTH_LIMIT deep, because Python hashes, compares and prints nested
    values by recursion.
    """

    def __init__(self) -> None:
        self.stack: list[Any] = []
        self.deep: list[int] = []
        self.marks: list[int] = []
        self.memo: dict[int, tuple[Any, int]] = {}

    def push(self, value: Any, depth: int = 0) -> None:
        if depth > DEPTH_LIMIT:
            raise NotData(f"it is nested more than {DEPTH_LIMIT} deep")
        self.stack.append(value)
        self.deep.append(depth)

    def pop(self) -> Any:
        return self.take(1)[0][0]

    def take(self, count: int) -> tuple[list[Any], int]:
        """Take the last `count` values, and the nesting of a container of them."""
        at = len(self.stack) - count
        if at < (self.marks[-1] if self.marks else 0):
            raise NotData("it is damaged: its stack is empty")
        values, depth = self.stack[at:], max(self.deep[at:], default=-1) + 1
        del self.stack[at:], self.deep[at:]
        return values, depth

    def since_mark(self) -> tuple[list[Any], int]:
        if not self.marks:
            raise NotData("it is damaged: it has no mark")
        count = len(self.stack) - self.marks[-1]
        found = self.take(count)
        self.marks.pop()
        return found

    def top(self, depth: int = 0) -> Any:
        """The last value, which is about to hold values nested `depth - 1` deep."""
        if len(self.stack) <= (self.marks[-1] if self.marks else 0):
            raise NotData("it is damaged: its stack is empty")
        self.deep[-1] = max(self.deep[-1], depth)
        if self.deep[-1] > DEPTH_LIMIT:
            raise NotData(f"it is nested more than {DEPTH_LIMIT} deep")
        return self.stack[-1]

    def step(self, name: str, argument: Any) -> None:
        match name:
            case "PROTO" | "FRAME":
                pass
            case _ if name in _CONSTANTS:
                self.push(_CONSTANTS[name])
            case _ if name in _LITERALS:
                self.push(argument)
            case _ if name in _EMPTY:
                self.push(_EMPTY[name]())
            case _ if name in _FIXED:
                values, depth = self.take(_FIXED[name])
                self.push(tuple(values), depth)
            case "MARK":
                self.marks.append(len(self.stack))
            case "TUPLE":
                values, depth = self.since_mark()
                self.push(tuple(values), depth)
            case "LIST":
                values, depth = self.since_mark()
                self.push(values, depth)
            case "APPEND" | "APPENDS":
                values, depth = self.since_mark() if name == "APPENDS" else self.take(1)
                _kind(self.top(depth), list).extend(values)
            case "DICT":
                values, depth = self.since_mark()
                self.push(dict(_pairs(values)), depth)
            case "SETITEM" | "SETITEMS":
                values, depth = self.since_mark() if name == "SETITEMS" else self.take(2)
                into = self.top(depth)
                _kind(into.items if isinstance(into, ObjectRecord) else into, dict).update(_pairs(values))
            case "PUT" | "BINPUT" | "LONG_BINPUT":
                self.memo[argument] = (self.top(), self.deep[-1])
            case "MEMOIZE":
                self.memo[len(self.memo)] = (self.top(), self.deep[-1])
            case "GET" | "BINGET" | "LONG_BINGET":
                self.push(*self.memo[argument])
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
                self.push(Global(module, member))
            case "STACK_GLOBAL":
                (module, member), _ = self.take(2)
                self.push(Global(_kind(module, str), _kind(member, str)))
            case "NEWOBJ" | "REDUCE":
                (what, args), depth = self.take(2)
                self.push(ObjectRecord(_kind(what, Global), _kind(args, tuple)), depth)
            case "BUILD":
                (state,), depth = self.take(1)
                _kind(self.top(depth), ObjectRecord).state = state
            case "BINPERSID":
                (key,), depth = self.take(1)
                self.push(Outside(key), depth)
            case _:
                raise NotData(f"it uses the operation {name}, which plain data has no need of")


def _kind(value: Any, kind: type) -> Any:
    if not isinstance(value, kind):
        raise NotData(f"it is damaged: {kind.__name__} expected where it has {type(value).__name__}")
    return value


def _pairs(values: list[Any]) -> list[tuple[Any, Any]]:
    """Keys with their values. Keys are names and numbers, which are hashed without recursion."""
    if len(values) % 2:
        raise NotData("it is damaged: a key without a value")
    for key in values[::2]:
        if not isinstance(key, _KEYS) or (isinstance(key, str) and len(key) > KEY_LIMIT):
            raise NotData(f"it has a key of type {type(key).__name__}, or a long one")
    return list(zip(values[::2], values[1::2]))
