"""Cells of one and of several lattices come back in the order of the finest one."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from scene_experts.core.errors import InputError
from scene_experts.core.reading.budget import Damaged
from scene_experts.files.anchors.places import Lattice, find_places, read_places, write_places
from scene_experts.files.codec.streams import SymbolReader, SymbolWriter
from support.compact import ORIGIN, make_scene


def back(places):
    writer = SymbolWriter()
    write_places(places, writer)
    return read_places(places.lattices, SymbolReader(writer.pack()))


@pytest.mark.parametrize("levels", [1, 3])
def test_places_come_back(levels):
    data = make_scene(200, **({"level": torch.arange(200) % levels} if levels > 1 else {}))
    places, order = find_places(data)
    found = back(places)
    assert len(places.lattices) == levels and np.array_equal(found.cells, data.cells.numpy()[order])
    assert (np.diff(found.keys.astype(np.int64)) >= 0).all() and np.array_equal(found.keys, places.keys)
    assert found.fine.min(0).tolist() == [0, 0, 0] and found.levels().tolist() == (order % levels).tolist()
    edges = torch.tensor([lattice.edge for lattice in places.lattices], dtype=torch.float64)[found.levels()]
    wanted = torch.from_numpy(found.cells) * edges[:, None] + torch.tensor(ORIGIN, dtype=torch.float64)
    assert torch.equal(found.columns(ORIGIN)["xyz"], wanted.float())


def test_lattices_come_back_as_json_and_others_are_refused():
    lattice = find_places(make_scene(9))[0].lattices[0]
    assert Lattice.from_plain(lattice.plain(), 9) == lattice
    for place, wrong in ((1, 0), (2, 0), (4, 10), (5, 10), (6, 22), (3, [0, 0, 1 << 60])):
        with pytest.raises(Damaged):
            Lattice.from_plain([*lattice.plain()[:place], wrong, *lattice.plain()[place + 1 :]], 9)


def test_cells_of_another_number_of_anchors():
    places = find_places(make_scene(30))[0]
    other = replace(places.lattices[0], count=31)
    writer = SymbolWriter()
    write_places(places, writer)
    with pytest.raises(Damaged):
        read_places([other], SymbolReader(writer.pack()))


def test_anchors_on_no_lattice():
    with pytest.raises(InputError, match="--format anchors"):
        find_places(replace(make_scene(3), cells=None))
