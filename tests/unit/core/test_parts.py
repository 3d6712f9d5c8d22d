"""The registry of parts."""

from dataclasses import dataclass
from typing import ClassVar

import pytest

from scene_experts.core import parts
from scene_experts.core.parts import Part, choice, choices, extend, find, load_with, names_of, register
from scene_experts.core.plain import lean
from scene_experts.training.losses import Weights
from support.messages import naming


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(parts, "_REGISTERED", {})
    monkeypatch.setattr(parts, "_LOADERS", [])


def test_a_part_is_found_by_name_and_kind():
    @register
    @dataclass(frozen=True)
    class Fruit(Part):
        weight: float = 1.0

    @register
    @dataclass(frozen=True)
    class Apple(Fruit):
        pass

    @register
    @dataclass(frozen=True)
    class Stone(Part):
        pass

    assert find("Apple", Fruit) is Apple and find("Apple", Part) is Apple and find("Stone", Fruit) is None and find("Pear", Part) is None
    assert names_of(Fruit) == ["Fruit", "Apple"]
    assert Apple().scaled(0.5) == Apple()


def make(module: str) -> type:
    kind = dataclass(frozen=True)(type("Plum", (Part,), {"__module__": module}))
    return kind


def test_a_name_belongs_to_one_class_which_may_be_defined_again():
    register(make("one"))
    again = make("one")
    assert register(again) is again and find("Plum", Part) is again
    with pytest.raises(ValueError, match=naming("Plum", "one", "another")):
        register(make("another"))


def test_only_frozen_dataclasses_are_parts():
    with pytest.raises(TypeError):
        register(int)  # type: ignore[type-var]
    with pytest.raises(TypeError, match=r"write @dataclass"):
        register(type("Undecorated", (Weights,), {"mine": 1.0}))  # a dataclass by its base alone: `mine` would be no setting


@dataclass(frozen=True)
class Tool(Part):
    name: ClassVar[str]


@pytest.mark.parametrize(
    ("hints", "values", "said"),
    [
        ({"size": float}, {"name": "saw"}, "a default for each setting.*Saw.size"),
        ({"version": int}, {"name": "saw", "version": 1}, "than type and version.*Saw.version"),
        ({}, {}, "a `name` for the command line in Saw"),
    ],
)
def test_a_part_that_no_run_could_use_is_refused(hints, values, said):
    with pytest.raises(TypeError, match=said):
        register(dataclass(frozen=True)(type("Saw", (Tool,), {"__annotations__": hints, **values})))


def test_a_name_for_the_command_line_belongs_to_one_part_of_a_kind():
    axe, other = (dataclass(frozen=True)(type(kind, (Tool,), {"name": "axe"})) for kind in ("Axe", "Hatchet"))
    register(axe)
    with pytest.raises(ValueError, match="'axe' in Hatchet, found it in Axe"):
        register(other)
    with pytest.raises(ValueError, match="'axe' in Sharp, found it in Axe"):
        register(dataclass(frozen=True)(type("Sharp", (axe,), {})))  # an inherited name
    assert choices(Tool) == {"axe": axe} and choice("axe", Tool) is axe


def test_a_part_that_is_not_known_is_looked_for_in_other_packages():
    late = dataclass(frozen=True)(type("Late", (Tool,), {"name": "late"}))
    calls = []
    load_with(lambda: calls.append(1) or register(late))
    assert find("Late", Tool) is late and choice("late", Tool) is late and calls == [1], "asked only where it was not known"
    assert find("Never", Tool) is None and choice("never", Tool) is None


def test_the_changes_of_a_base_count_for_its_subclasses():
    base = dataclass(frozen=True)(type("Base", (Part,), {"changes": ("It computes something else.",)}))
    plain = dataclass(frozen=True)(type("Plain", (base,), {}))
    own = dataclass(frozen=True)(type("Own", (base,), {"changes": ("It differs too.", "And again.")}))
    assert [kind.version() for kind in (Part, base, plain, own)] == [0, 1, 1, 3]
    assert lean(own()) == {"type": "Own", "version": 3}


def test_a_part_of_a_subclass_keeps_the_numbers():
    @dataclass(frozen=True)
    class More(Weights):
        mine: float = 0.0

    base = Weights(load=0.5, tau=0.25)
    made = extend(base, More, mine=2.0)
    assert type(made) is More and (made.load, made.tau, made.mine) == (0.5, 0.25, 2.0)
    with pytest.raises(TypeError, match="subclass of More"):
        extend(made, Weights)
    with pytest.raises(TypeError, match="yours"):
        extend(base, More, yours=1.0)
