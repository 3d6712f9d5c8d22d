"""Codes a scene of anchors of which a coarse part is known: chunk by chunk along the Morton curve.

The coarse part holds some of the anchors, with coarse values and masks. A chunk first refines its
coarse anchors, then adds its other anchors, whose parents are coarse anchors. So any number of
chunks leaves a scene: refined chunks, and the coarse part elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scene_experts.core.reading.budget import Damaged
from scene_experts.core.threads import one_thread
from scene_experts.files.codec.fit import ROWS, blank_model, fit_model
from scene_experts.files.codec.groups import CLASS, CLASSES, FEATURE, OFFSETS, SCALING, SLOTS, UNIT, ChannelGroup, GroupModel, anchor_groups
from scene_experts.files.codec.order import LEVELS
from scene_experts.files.codec.reference import Ints
from scene_experts.files.codec.streams import Inputs, SymbolReader, SymbolWriter, as_inputs, blend, find_parents, predict
from scene_experts.files.formats.morton import Keys, unmorton
from scene_experts.scene.anchors.quantise import HIGH_CLASS, LOW_CLASS

Visit = Callable[[ChannelGroup, Ints, NDArray[np.int16], int, NDArray[np.bool_] | None], None]
"""visit(group, rows [n], inputs [D, n] of the last channel, number of inputs of the first one, live
[slots, n])."""
MORE = "+"
"""Behind the name of a group: the model of it that refines."""
ADDED, COARSE = 0, 1  # which of the inputs for levels is set


def groups_of(F: int, K: int, has_slots: bool, extra: int) -> tuple[ChannelGroup, ...]:
    """The groups of `anchor_groups`; slots may be left out even where all of them have values."""
    return tuple(replace(g, masked=3 if g.name == OFFSETS else 0) for g in anchor_groups(F, K, has_slots, extra))


def refined_groups(groups: Sequence[ChannelGroup]) -> tuple[ChannelGroup, ...]:
    """The groups that refine coarse anchors, for those of `anchor_groups`. Their classes and further
    columns are known."""
    own = {FEATURE: (), SCALING: (FEATURE,), SLOTS: (FEATURE,), OFFSETS: (FEATURE, SCALING)}
    return tuple(
        ChannelGroup(
            g.name + MORE,
            g.channels,
            own[g.name],
            from_parents=False,
            is_chain=g.is_chain,
            is_binary=g.is_binary,
            has_steps=g.has_steps,
            masked=g.masked,
            refines=True,
        )
        for g in groups
        if g.name in own
    )


@dataclass(frozen=True)
class CoarsePart:
    """Where the coarse anchors are among N anchors along the curve, and the chunks."""

    is_coarse: NDArray[np.bool_]
    """[N]"""
    parents: Ints
    """[N, 4] coarse anchors, by their places along the curve"""
    weights: Ints
    """[N, 4] in 1/256"""
    chunks: list[NDArray[np.int32]]
    """Places along the curve of the anchors of each chunk, in the order of the chunks."""

    @classmethod
    def of(cls, keys: Keys, is_coarse: NDArray[np.bool_], order: Sequence[int], slow: bool = False) -> CoarsePart:
        """keys: [N], ascending; order: of the chunks, which divide the curve evenly. Raises Damaged
        for an order that is none."""
        n, count = len(keys), len(order)
        if sorted(order) != list(range(count)):
            raise Damaged("chunks in no order")
        cells, rows = unmorton(keys).astype(np.int32), np.arange(n, dtype=np.int32)
        parents, weights = find_parents(cells, rows, np.flatnonzero(is_coarse).astype(np.int32), slow)
        return cls(is_coarse, parents, weights, [rows[i * n // count : (i + 1) * n // count] for i in order])


class Refiner:
    """Codes chunk after chunk. One writes, another one reads the same.

    values: by group, [C, N] int32 along the curve, those that are known: of coarse anchors at
    first. is_known: [N].
    """

    def __init__(
        self,
        groups: Sequence[ChannelGroup],
        part: CoarsePart,
        coarse: Mapping[str, Ints],
        models: Mapping[str, GroupModel],
        slow: bool = False,
    ) -> None:
        """coarse: by group, [C, N] int32 in the steps of the whole scene, 0 for other anchors. It
        has masks also where `groups` have none. models: by name, of `groups` and of
        `refined_groups`."""
        self.groups, self.more, self.part, self.models, self.slow = groups, refined_groups(groups), part, models, slow
        self.has_slots = any(g.name == SLOTS for g in groups)
        self.values = {name: np.ascontiguousarray(value, np.int32).copy() for name, value in coarse.items()}
        self.is_known = part.is_coarse.copy()
        self.columns: dict[str, NDArray[np.int16]] = {}
        known = np.flatnonzero(part.is_coarse)
        classes, none = self.values[CLASS][0].astype(np.int8), np.zeros(len(known), np.int8)
        for g in groups:
            self.columns[g.name] = np.zeros((g.channels, len(self.is_known)), np.int16)
            for c in range(g.channels):
                self.set_column(g.name, c, known, classes[known] if g.has_steps else none)

    def set_column(self, name: str, c: int, rows: NDArray[Any], classes: NDArray[np.int8]) -> None:
        """Make inputs of the values of a channel at rows [n], which have classes [n]."""
        values, scaling = np.ascontiguousarray(self.values[name][c, rows]), self.models[name].scaling[c].tolist()
        self.columns[name][c, rows] = as_inputs(values, classes, *scaling, slow=self.slow)

    def write(self, number: int, values: Mapping[str, Ints]) -> bytes:
        """The stream of a chunk. values: by group, [C, N] of the whole scene."""
        writer = SymbolWriter(self.slow)

        def code(group: ChannelGroup, c: int, rows: Ints, mean: Ints, scale: Ints) -> Ints:
            found = np.ascontiguousarray(values[group.name.removesuffix(MORE)][c, rows])
            if group.is_binary:
                writer.bits(found.astype(np.uint8), scale)
            else:
                writer.symbols(found, mean, scale)
            return found

        self.visit_chunk(number, self._coder(code))
        return writer.pack()

    def read(self, number: int, stream: bytes) -> None:
        """Take the chunk of a stream. Raises Damaged for one that does not fit."""
        reader = SymbolReader(stream, self.slow)

        def code(group: ChannelGroup, c: int, rows: Ints, mean: Ints, scale: Ints) -> Ints:
            found = reader.bits(scale).astype(np.int32) if group.is_binary else reader.symbols(mean, scale)
            if group.name == CLASS and len(found) and not LOW_CLASS <= found.min() <= found.max() <= HIGH_CLASS:
                raise Damaged("a step class out of range")
            return found

        self.visit_chunk(number, self._coder(code))
        reader.finish()

    def _coder(self, code: Callable[[ChannelGroup, int, Ints, Ints, Ints], Ints]) -> Visit:
        """A visitor of `_chunk` that codes the channels of a group one after the other."""

        def visit(group: ChannelGroup, rows: Ints, inputs: NDArray[np.int16], used: int, live: NDArray[np.bool_] | None) -> None:
            name, model, classes = group.name.removesuffix(MORE), self.models[group.name], self.classes(group, rows)
            found = Inputs(inputs)
            for c in range(group.channels):
                mean, scale = predict(found, model.weights[c], model.numbers[c].tolist(), classes, self.slow)
                if live is None:
                    self.values[name][c, rows] = code(group, c, rows, mean, scale)
                else:
                    chosen = live[c // group.masked]
                    self.values[name][c, rows[chosen]] = code(group, c, rows[chosen], mean[chosen], scale[chosen])
                self.set_column(name, c, rows, classes)
                if group.is_chain:
                    inputs[used] = self.columns[name][c, rows]
                    used += 1

        return visit

    def classes(self, group: ChannelGroup, rows: Ints) -> NDArray[np.int8]:
        """The step classes [n] that scale a group's steps at rows [n]."""
        found = self.values[CLASS][0, rows]
        return found.astype(np.int8) if group.has_steps else np.zeros(len(found), np.int8)

    def visit_chunk(self, number: int, visit: Visit) -> None:
        """Go through the groups of a chunk: those that refine, then those of other anchors."""
        rows, slots = self.part.chunks[number], self.values[SLOTS]
        coarse, added = rows[self.part.is_coarse[rows]], rows[~self.part.is_coarse[rows]]
        if len(coarse):
            before = slots[:, coarse] != 0
            after = before
            for group in self.more:
                if group.masked and not self.has_slots:
                    slots[:, coarse] = 1
                after = slots[:, coarse] != 0
                visit(group, coarse, *self._inputs(group, coarse, COARSE), before & after if group.masked else None)
            offsets = self.groups[-1]  # of slots that the coarse part left out
            visit(offsets, coarse, *self._inputs(offsets, coarse, COARSE), after & ~before)
        for group in self.groups if len(added) else ():
            if group.masked and not self.has_slots:
                slots[:, added] = 1
            visit(group, added, *self._inputs(group, added, ADDED), slots[:, added] != 0 if group.masked else None)
        self.is_known[rows] = True

    def _inputs(self, group: ChannelGroup, rows: Ints, kind: int) -> tuple[NDArray[np.int16], int]:
        name = group.name.removesuffix(MORE)
        columns = [self.columns[own][:, rows] for own in group.own]
        columns += [blend(self.columns[name], self.part.parents[rows], self.part.weights[rows], self.slow)] if group.from_parents else []
        columns += [self.columns[name][:, rows]] if group.refines else []
        known = LEVELS + (CLASSES if group.has_steps else 0)
        used = known + sum(map(len, columns))
        out = np.zeros((used + (group.channels if group.is_chain else 0), len(rows)), np.int16)
        out[kind] = UNIT
        if group.has_steps:
            out[LEVELS:known] = (np.arange(LOW_CLASS, HIGH_CLASS + 1)[:, None] == self.classes(group, rows)) * np.int16(UNIT)
        if columns:
            np.concatenate(columns, out=out[known:used])
        return out, used


def fit_refinement(
    groups: Sequence[ChannelGroup], part: CoarsePart, coarse: Mapping[str, Ints], values: Mapping[str, Ints]
) -> dict[str, GroupModel]:
    """Models by name of `groups` and of `refined_groups`, for values [C, N] by group along the
    curve."""
    every, channels = max(1, -(-len(part.is_coarse) // ROWS)), {g.name: g.channels for g in groups}
    both = {g.name: g for g in (*groups, *refined_groups(groups))}
    models = {name: blank_model(g, channels, values[name.removesuffix(MORE)], values[CLASS][0]) for name, g in both.items()}
    refiner, seen = Refiner(groups, part, coarse, models), {name: list[tuple[NDArray, ...]]() for name in models}

    def visit(group: ChannelGroup, rows: Ints, inputs: NDArray[np.int16], used: int, live: NDArray[np.bool_] | None) -> None:
        name, classes = group.name.removesuffix(MORE), refiner.classes(group, rows)
        found = values[name][:, rows]
        if live is not None:
            kept = np.repeat(live, group.masked, 0)
            refiner.values[name][:, rows] = np.where(kept, found, refiner.values[name][:, rows])
            found = found * kept
        else:
            refiner.values[name][:, rows] = found
        for c in range(group.channels):
            refiner.set_column(name, c, rows, classes)
        if group.is_chain:
            inputs[used:] = refiner.columns[name][:, rows]
        mask = np.zeros((0, len(rows)), bool) if live is None else live
        seen[group.name].append((inputs[:, ::every], found[:, ::every], classes[::every], mask[:, ::every]))

    for number in range(len(part.chunks)):
        refiner.visit_chunk(number, visit)
    for name, group in both.items():
        if seen[name]:
            inputs, found, classes, mask = (np.concatenate(arrays, -1) for arrays in zip(*seen[name]))
            with one_thread():
                models[name] = fit_model(group, models[name], inputs, found, classes, mask if group.masked else None)
    return models
