"""Groups of channels, the integer models that predict them, and the walk that codes them.

A channel's value is predicted, mean and spread, by two linear functions of what is decoded already:
the level, the step class, earlier groups and earlier channels of the same anchor, and the weighted
mean of the group's values at the anchor's parents (`order`). Weights are 8-bit and sums 32-bit
integers.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged
from scene_experts.files.codec.order import LEVELS, CodingOrder
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import MOST_INPUTS, Inputs, SymbolReader, SymbolWriter, as_inputs, blend, predict
from scene_experts.scene.anchors.quantise import HIGH_CLASS, LOW_CLASS

CLASSES = HIGH_CLASS - LOW_CLASS + 1
UNIT = 32  # an input of 32 is one standard deviation, or "yes"
MOST_FACTOR, MOST_OFFSET, MOST_BIAS, MOST_SHIFT = 1 << 20, 1 << 28, 1 << 28, 24
CLASS, FEATURE, SCALING, EXTRA, SLOTS, OFFSETS = "class", "feature", "scaling", "extra", "slots", "offsets"
ORDER = (CLASS, FEATURE, SCALING, EXTRA, SLOTS, OFFSETS)


@dataclass(frozen=True)
class ChannelGroup:
    """Channels that are coded one after the other."""

    name: str
    channels: int
    own: tuple[str, ...] = ()
    """Earlier groups of the same anchor that predict it."""
    from_parents: bool = True
    is_chain: bool = True
    """Whether earlier channels of the group predict later ones."""
    is_binary: bool = False
    has_steps: bool = True
    """Whether the anchor's class scales its steps. Then the class predicts the group too."""
    masked: int = 0
    """Channels of each slot, if those of masked slots are left out; 0: none are."""
    refines: bool = False
    """Whether coarse values of the same channels are known and predict it (`refine`)."""

    @property
    def has_mean(self) -> bool:
        """Whether anything but the class predicts the mean."""
        return self.from_parents or self.is_chain or self.refines


def anchor_groups(F: int, K: int, has_slots: bool = False, extra: int = 0) -> tuple[ChannelGroup, ...]:
    """The groups of anchors with F features, six lengths, `extra` further columns and K
    Gaussians."""
    slots = (ChannelGroup(SLOTS, K, (FEATURE,), is_binary=True, has_steps=False),) if has_slots else ()
    others = (ChannelGroup(EXTRA, extra, (SCALING,), has_steps=False),) if extra else ()
    return (
        ChannelGroup(CLASS, 1, has_steps=False),
        ChannelGroup(FEATURE, F),
        ChannelGroup(SCALING, 6, (FEATURE,)),
        *others,
        *slots,
        ChannelGroup(OFFSETS, 3 * K, (FEATURE, SCALING), from_parents=False, is_chain=False, masked=3 if has_slots else 0),
    )


@dataclass(frozen=True)
class GroupModel:
    """The model of one group of C channels."""

    weights: list[NDArray[np.int8]]
    """[2, D] each, of the mean and of the spread; D grows along a chain."""
    numbers: Ints
    """[C, 4]: bias and shift of the mean, bias and shift of the spread."""
    scaling: Ints
    """[C, 2]: factor and offset that make inputs of the values (`reference.as_inputs`); [0, 2] of a
    group that refines, whose values become inputs as those of the group that it refines."""

    def checked(self) -> GroupModel:
        """This model. Raises Damaged for numbers that the sums could not bear."""
        biases, shifts = self.numbers[:, ::2], self.numbers[:, 1::2]
        factor, offset = self.scaling.T
        fits = np.abs(biases.astype(np.int64)).max(initial=0) <= MOST_BIAS and np.abs(shifts).max(initial=0) <= MOST_SHIFT
        if not fits or ((factor < 1) | (factor > MOST_FACTOR)).any() or np.abs(offset.astype(np.int64)).max(initial=0) > MOST_OFFSET:
            raise Damaged("a model with numbers out of range")
        return self


def inputs_of(group: ChannelGroup, channels: Mapping[str, int]) -> list[int]:
    """How many inputs each channel of a group has. channels: of the groups by name."""
    fixed = LEVELS + (CLASSES if group.has_steps else 0) + sum(channels[name] for name in group.own)
    fixed += group.channels * (group.from_parents + group.refines)
    found = [fixed + (c if group.is_chain else 0) for c in range(group.channels)]
    if found and found[-1] > MOST_INPUTS:
        raise Damaged(f"{found[-1]:,} inputs of a model, more than {MOST_INPUTS:,}")
    return found


class Walk:
    """Codes the values of all groups, level by level. One walk writes, another one reads the same.

    values: by group, [C, N] int32 in coding order. Readers begin with zeros. columns: the same as
    inputs, int16.
    """

    def __init__(self, groups: Sequence[ChannelGroup], order: CodingOrder, models: Mapping[str, GroupModel], slow: bool = False) -> None:
        self.groups, self.order, self.models, self.slow = groups, order, models, slow
        self.count = len(order.rows)
        self.values = {g.name: np.zeros((g.channels, self.count), np.int32) for g in groups}
        self._needed = {name for g in groups for name in g.own} | {g.name for g in groups if g.is_chain or g.from_parents}
        self.columns = {g.name: np.zeros((g.channels if g.name in self._needed else 0, self.count), np.int16) for g in groups}

    def write(self, values: Mapping[str, Ints]) -> dict[str, SymbolWriter]:
        """The streams by group of values by group."""
        self.values = {name: np.ascontiguousarray(value, np.int32) for name, value in values.items()}
        out = {group.name: SymbolWriter(self.slow) for group in self.groups}

        def code(group: ChannelGroup, found: Ints, mean: Ints, scale: Ints) -> None:
            if group.is_binary:
                out[group.name].bits(found.astype(np.uint8), scale)
            else:
                out[group.name].symbols(found, mean, scale)

        self._run(code)
        return out

    def read(self, streams: Mapping[str, bytes]) -> dict[str, Ints]:
        """The values by group of streams by group. Raises Damaged for streams that do not fit."""
        readers = {group.name: SymbolReader(streams[group.name], self.slow) for group in self.groups}

        def code(group: ChannelGroup, found: Ints, mean: Ints, scale: Ints) -> None:
            reader = readers[group.name]
            if group.is_binary:
                found[:] = reader.bits(scale)
            else:
                reader.symbols(mean, scale, found)
            if group.name == CLASS and len(found) and not LOW_CLASS <= found.min() <= found.max() <= HIGH_CLASS:
                raise Damaged("a step class out of range")

        self._run(code)
        for reader in readers.values():
            reader.finish()
        return self.values

    def _run(self, code: Callable[[ChannelGroup, Ints, Ints, Ints], None]) -> None:
        """code(group, values, mean, scale) writes values, or reads them into their place."""
        for level, places in enumerate(self.order.levels):
            for group in self.groups if places.stop > places.start else ():
                self._run_group(group, level, places, code)

    def _run_group(self, group: ChannelGroup, level: int, places: slice, code: Callable[[ChannelGroup, Ints, Ints, Ints], None]) -> None:
        model, classes = self.models[group.name], self.classes(group, places)
        inputs, columns = self.inputs(group, level, places), self.columns[group.name][:, places]
        for c in range(group.channels):
            mean, scale = predict(inputs, model.weights[c], model.numbers[c].tolist(), classes, self.slow)
            values = self.values[group.name][c, places]
            if group.masked:
                live = self.values[SLOTS][c // group.masked, places] != 0
                chosen = values[live]
                code(group, chosen, mean[live], scale[live])
                values[live] = chosen
            else:
                code(group, values, mean, scale)
            if group.name in self._needed:
                as_inputs(values, classes, *model.scaling[c].tolist(), out=columns[c], slow=self.slow)
                if group.is_chain:
                    inputs.append(columns[c : c + 1])

    def classes(self, group: ChannelGroup, places: slice) -> NDArray[np.int8]:
        """The step classes [n] that scale a group's steps at places of the coding order."""
        found = self.values[CLASS][0, places]
        return found.astype(np.int8) if group.has_steps else np.zeros(len(found), np.int8)

    def inputs(self, group: ChannelGroup, level: int, places: slice) -> Inputs:
        """The inputs [D, n] of a group's first channel at the places of a level."""
        known = np.zeros((LEVELS, places.stop - places.start), np.int16)
        known[level] = UNIT
        out = Inputs(known)
        if group.has_steps:
            classes = np.arange(LOW_CLASS, HIGH_CLASS + 1, dtype=np.int8)[:, None]
            out.append((classes == self.classes(group, places)) * np.int16(UNIT))
        for name in group.own:
            out.append(self.columns[name][:, places])
        if group.from_parents:
            out.append(blend(self.columns[group.name], *self.order.parents[level], slow=self.slow))
        return out
