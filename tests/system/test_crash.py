"""Trainings of every family, killed at random moments and resumed, end as if they had been left alone (`make crash` for many more)."""

import subprocess
import sys

import pytest

from support.places import ROOT


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks trainings")
def test_killed_trainings_of_every_family_end_as_if_left_alone():
    args = [sys.executable, str(ROOT / "tools" / "crash.py"), "--rounds", "8"]
    done = subprocess.run(args, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stderr
    assert "kills: " in done.stdout and "compared: " in done.stdout
