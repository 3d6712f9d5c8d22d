"""A mapping that is computed when somebody looks into it."""

from scene_experts.core.lazy import LazyMapping


def test_it_is_computed_once_and_only_if_somebody_looks():
    calls = []
    found = LazyMapping(lambda: calls.append(1) or {"a": 2, "b": 3})
    assert not calls
    assert found["a"] == 2 and dict(found) == {"a": 2, "b": 3} and len(found) == 2 and "c" not in found
    assert calls == [1]
    assert not LazyMapping(dict)
