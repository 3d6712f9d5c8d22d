import pytest
import torch

from scene_experts.core.table import Table
from support.messages import naming


def make(n=4):
    torch.manual_seed(0)
    return Table(
        {"a": torch.randn(n, 2), "b": torch.randn(n, 3, 2)}, {"cell": torch.arange(n * 3).reshape(n, 3)}, {"seen": torch.arange(n).float()}
    )


def adam(table):
    optimizer = torch.optim.Adam([{"params": [p], "name": k} for k, p in table.params.items()], lr=0.1)
    table.attach(optimizer)
    return optimizer


def step(table, optimizer):
    optimizer.zero_grad()
    sum((p * (i + 1)).square().sum() for i, p in enumerate(table.params.values())).backward()
    optimizer.step()


def test_to_moves_facts_and_statistics_too_and_keeps_integers():
    table = make().to("meta", torch.float64)
    columns = {**table.columns(), **table.stats}
    assert {v.device.type for v in columns.values()} == {"meta"}
    assert {k: v.dtype for k, v in columns.items()} == {
        "a": torch.float64,
        "b": torch.float64,
        "cell": torch.int64,
        "seen": torch.float64,
    }
    assert all(isinstance(p, torch.nn.Parameter) for p in table.params.values())


def test_append_adds_rows_with_zero_moments_and_statistics():
    table = make()
    optimizer = adam(table)
    step(table, optimizer)
    before = {k: optimizer.state[p]["exp_avg"].clone() for k, p in table.params.items()}
    table.append({"a": torch.ones(2, 2), "b": torch.ones(2, 3, 2), "cell": torch.full((2, 3), 9)})
    assert len(table) == 6
    assert table.stats["seen"].tolist() == [0, 1, 2, 3, 0, 0]
    assert table.facts["cell"][4:].unique().tolist() == [9]
    for name, parameter in table.params.items():
        state = optimizer.state[parameter]
        assert torch.equal(state["exp_avg"][:4], before[name]) and not state["exp_avg"][4:].any() and not state["exp_avg_sq"][4:].any()
        assert float(state["step"]) == 1
    step(table, optimizer)  # the new rows train


def test_keep_filters_every_column_and_moment_together():
    table = make()
    optimizer = adam(table)
    step(table, optimizer)
    a, moment = table.params["a"].detach().clone(), optimizer.state[table.params["a"]]["exp_avg"].clone()
    mask = torch.tensor([True, False, True, False])
    table.keep(mask)
    assert torch.equal(table.params["a"], a[mask]) and torch.equal(optimizer.state[table.params["a"]]["exp_avg"], moment[mask])
    assert table.facts["cell"][:, 0].tolist() == [0, 6] and table.stats["seen"].tolist() == [0, 2]
    assert all(p in optimizer.state for p in table.params.values()) and len(optimizer.state) == 2


def test_a_row_trains_the_same_whether_others_come_and_go():
    alone, mixed = make(), make()
    o1, o2 = adam(alone), adam(mixed)
    for i in range(6):
        step(alone, o1)
        step(mixed, o2)
        if i == 2:
            mixed.append({"a": torch.ones(3, 2), "b": torch.ones(3, 3, 2), "cell": torch.zeros(3, 3)})
        if i == 4:
            mixed.keep(torch.tensor([True] * 4 + [False] * 3))
    assert torch.equal(alone.params["a"], mixed.params["a"]) and torch.equal(alone.params["b"], mixed.params["b"])


def test_assign_clears_moments_and_begins_the_average_anew():
    table = make()
    optimizer = adam(table)
    step(table, optimizer)
    table.averages = {name: p.detach() + 1 for name, p in table.params.items()}
    others = table.averages["b"].clone()
    table.assign("a", torch.zeros(4, 2))
    assert torch.equal(table.averages["a"], torch.zeros(4, 2)) and torch.equal(table.averages["b"], others)
    state = optimizer.state[table.params["a"]]
    assert not state["exp_avg"].any() and not state["exp_avg_sq"].any() and not table.params["a"].any()
    table.params["a"].data += 1
    assert not table.averages["a"].any()  # it is a copy


def test_errors_name_what_differs():
    table = make()
    with pytest.raises(KeyError, match=r"\['a', 'b', 'cell'\].*\['a'\]"):
        table.append({"a": torch.ones(1, 2)})
    with pytest.raises(ValueError, match=naming("(4,)", "(3,)")):
        table.keep(torch.ones(3, dtype=torch.bool))
    with pytest.raises(ValueError, match=naming("a", 2, "f", 3)):
        Table({"a": torch.ones(2, 1)}, {"f": torch.ones(3)})
    with pytest.raises(ValueError, match="'a'"):
        table.attach(torch.optim.Adam(table.params.values(), lr=0.1))


def test_overwrite_sets_rows_and_clears_only_their_moments():
    table = make()
    optimizer = adam(table)
    step(table, optimizer)
    name, value = next(iter(table.params.items()))
    before, moments = value.detach().clone(), {n: optimizer.state[p]["exp_avg"].clone() for n, p in table.params.items()}
    rows = torch.tensor([2, 0])
    table.overwrite(rows, {name: torch.full_like(before[rows], 7.0)})
    assert torch.equal(table.params[name].detach()[rows], torch.full_like(before[rows], 7.0))
    assert torch.equal(table.params[name].detach()[[1, 3]], before[[1, 3]])
    assert all(torch.equal(optimizer.state[p]["exp_avg"], moments[n]) for n, p in table.params.items())
    table.overwrite(rows, {}, clear=True)
    for n, p in table.params.items():
        state = optimizer.state[p]
        assert moments[n].any() and not state["exp_avg"][rows].any() and not state["exp_avg_sq"][rows].any(), n
        assert torch.equal(state["exp_avg"][[1, 3]], moments[n][[1, 3]]) and float(state["step"]) > 0
    assert table.device == torch.device("cpu")
