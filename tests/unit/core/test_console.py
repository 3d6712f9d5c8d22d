"""A console whose reader goes away."""

import os
import subprocess
import sys

import pytest

from scene_experts.core.console import LastingConsole

WRITES = """
import signal, sys
signal.signal(signal.SIGINT, signal.{})
from scene_experts.core.console import LastingConsole
console = LastingConsole(markup=False)
try:
    for line in range(100_000):
        console.print(line)
except KeyboardInterrupt:
    console.print("quiet from here on")
    print("saved", file=sys.stderr)
    sys.exit(130)
"""


@pytest.mark.skipif(os.name == "nt", reason="Windows has no broken pipes of this kind")
@pytest.mark.parametrize("handler", ["default_int_handler", "SIG_IGN"])  # ignored: in the background of a shell
def test_a_reader_that_goes_away_interrupts_the_command_which_can_save(handler):
    with subprocess.Popen(
        [sys.executable, "-c", WRITES.format(handler)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "0\n"
        process.stdout.close()
        said = process.stderr.read()
    assert process.returncode == 130 and said.endswith("saved\n") and len(said.splitlines()) == 2


def test_it_prints_as_a_console_does(capsys):
    LastingConsole(markup=False, highlight=False).print("[1] of 2")
    assert capsys.readouterr().out == "[1] of 2\n"
