"""Signals that end a command, and runs that do not outlive who started them."""

import os
import signal
import subprocess
import sys

import pytest

from scene_experts.core.signals import PARENT, ending, handled

pytestmark = pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="a system without SIGHUP")


@pytest.fixture(autouse=True)
def in_a_terminal():
    """The tests themselves may run under `nohup`."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


def test_a_closed_terminal_ends_a_command_unless_it_was_started_to_outlive_it():
    assert ending() == [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        assert ending() == [signal.SIGINT, signal.SIGTERM]
    finally:
        signal.signal(signal.SIGHUP, before)


def test_what_signals_did_before_they_do_again():
    before, seen = [signal.getsignal(number) for number in ending()], []
    with handled(lambda number, _: seen.append(number)):
        for number in ending():
            os.kill(os.getpid(), number)
    assert seen == [signal.SIGINT, signal.SIGTERM, signal.SIGHUP] and [signal.getsignal(number) for number in ending()] == before


CHILD = """
import signal, sys, time
from scene_experts.core.signals import follow_parent
def saved(*_):
    print("saved", flush=True)
    sys.exit(0)
signal.signal(signal.SIGTERM, saved)
follow_parent(every=0.05)
print("here", flush=True)
time.sleep(60)
"""
STARTER = """
import os, subprocess, sys, time
env = {**os.environ, sys.argv[1]: str(os.getpid())}
subprocess.Popen([sys.executable, "-c", sys.argv[2]], env=env)
time.sleep(60)
"""


def test_a_run_saves_and_ends_when_what_started_it_is_killed():
    starter = subprocess.Popen([sys.executable, "-c", STARTER, PARENT, CHILD], stdout=subprocess.PIPE, text=True)
    assert starter.stdout is not None and starter.stdout.readline() == "here\n"
    starter.kill()
    assert starter.stdout.readline() == "saved\n"  # it has inherited the pipe
    starter.wait()
