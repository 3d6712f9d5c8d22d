"""What a field says about its setting: ranges, scaled schedules, where it has an effect."""

from dataclasses import dataclass, field
from typing import Annotated, Literal

import pytest

from scene_experts.core.errors import InputError
from scene_experts.core.fields import SCALES, Count, Flag, Needs, Range, Scales, changed_without, check_fields, flag_of, note, scale


@dataclass(frozen=True)
class Window:
    start: Annotated[int, SCALES] = 100
    interval: Count = 10


@dataclass(frozen=True)
class Settings:
    share: Annotated[float, Range(0, below=1)] = 0.5
    power: Annotated[float | None, Range(above=0, high=1)] = None
    only: Annotated[tuple[int, ...], Range(1, 9), SCALES] = ()
    kind: Literal["round", "floor"] = "round"
    names: tuple[Literal["a", "b"], ...] = ()
    weight: Annotated[float, Range(0), Needs("wings")] = 0.0
    least: Annotated[int, Scales(least=5)] = 20
    window: Window = field(default_factory=Window)

    def check(self, flag: Flag) -> None:
        if self.least > self.window.start:
            raise InputError(f"expected {flag('least')} up to {flag('window.start')}")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"share": 1.0}, "expected --part.share from 0 to below 1, found 1.0; give a smaller number or leave it out"),
        ({"share": -0.1}, "expected --part.share from 0 to below 1, found -0.1; give a larger number or leave it out"),
        ({"share": float("nan")}, "expected --part.share as a finite number, found nan; correct it or leave it out"),
        ({"power": 0.0}, "expected --part.power above 0 and at most 1, found 0.0; give a larger number or leave it out"),
        ({"only": (3, 10)}, "expected --part.only from 1 to 9, found 10; give a smaller number or leave it out"),
        ({"kind": "ceil"}, "expected --part.kind among round, floor, found 'ceil'; choose one of those"),
        ({"names": ("a", "c")}, "expected --part.names among a, b, found 'c'; choose one of those"),
        ({"weight": -1.0}, "expected --part.weight of at least 0, found -1.0; give a larger number or leave it out"),
        ({"window": Window(interval=0)}, "expected --part.window.interval of at least 1, found 0; give a larger number or leave it out"),
        ({"least": 101}, "expected --part.least up to --part.window.start"),
    ],
)
def test_a_setting_out_of_range_is_named_in_one_sentence(wrong, said):
    check_fields(Settings(), "part")
    with pytest.raises(InputError) as error:
        check_fields(Settings(**wrong), "part")
    assert str(error.value) == said


def test_ranges_in_words():
    words = {str(r) for r in (Range(1), Range(high=1000), Range(above=0), Range(below=2), Range(above=0, below=1))}
    assert words == {"of at least 1", "at most 1,000", "above 0", "below 2", "above 0 and below 1"}


def test_iterations_grow_with_the_training_and_nothing_else():
    assert scale(Settings(only=(2, 4)), 0.5) == Settings(only=(1, 2), least=10, window=Window(start=50))
    assert scale(Settings(), 0.1).least == 5 and scale(Window(), 1.0) == Window()


def test_settings_without_an_effect_are_those_that_need_what_is_missing():
    assert list(changed_without(Settings(weight=1.0), frozenset())) == ["weight"]
    assert list(changed_without(Settings(weight=1.0), frozenset({"wings"}))) == list(changed_without(Settings(), frozenset())) == []


def test_flags_and_notes():
    assert flag_of("scene.voxel_size") == "--scene.voxel-size"
    assert note(Settings, "share", Range) == Range(0, below=1) and note(Settings, "share", Needs) is None
