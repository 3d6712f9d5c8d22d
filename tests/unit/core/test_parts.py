"""The registry of parts."""

from dataclasses import dataclass

import pytest

from scene_experts.core import parts
from scene_experts.core.parts import Part, extend, find, names_of, register
from scene_experts.training.losses import Weights
from support.messages import naming


@pytest.fixture(autouse=True)
def fresh(monkeypatch):
    monkeypatch.setattr(parts, "_REGISTERED", {})


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
