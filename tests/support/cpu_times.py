"""A pytest plugin that prints the tests that used the most CPU time, in their process and in those they started.

    python -m pytest -p support.cpu_times

Use it to decide which tests to mark `slow`. Tests run one after the other (without -n), so that each time is that of one test.
"""

import os

import pytest

SHOWN = 60
times: dict[str, float] = {}


def used() -> float:
    """CPU seconds of this process and of the processes that it has waited for."""
    t = os.times()
    return t.user + t.system + t.children_user + t.children_system


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item):
    before = used()
    done = yield
    times[f"{item.nodeid}{' (slow)' if 'slow' in item.keywords else ''}"] = used() - before
    return done


def pytest_terminal_summary(terminalreporter) -> None:
    fast = sum(seconds for name, seconds in times.items() if not name.endswith(" (slow)"))
    terminalreporter.write_line(f"CPU seconds: {sum(times.values()):.0f} in all, {fast:.0f} in tests that are not slow; the most:")
    for name, seconds in sorted(times.items(), key=lambda pair: -pair[1])[:SHOWN]:
        terminalreporter.write_line(f"{seconds:7.1f} {name}")
