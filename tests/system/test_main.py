"""`python -m scene_experts` is the command, and the package says its version without loading torch."""

import os
import subprocess
import sys

import scene_experts


def test_python_m_runs_the_command_and_passes_its_exit_code_on():
    said = subprocess.run([sys.executable, "-m", "scene_experts", "--version"], capture_output=True, text=True, check=False)
    assert (said.returncode, said.stdout) == (0, f"scene-experts {scene_experts.__version__}\n")
    bad = subprocess.run([sys.executable, "-m", "scene_experts", "trian"], capture_output=True, text=True, check=False)
    assert bad.returncode == 2 and bad.stdout == "" and bad.stderr.count("\n") == 1


def test_the_package_alone_is_light():
    probe = "import sys, scene_experts; sys.exit(any(m in sys.modules for m in ('torch', 'numpy')))"
    assert subprocess.run([sys.executable, "-c", probe], check=False).returncode == 0


def test_waiting_threads_sleep_unless_the_user_says_otherwise():
    probe = [sys.executable, "-c", "import os, scene_experts; print(os.environ['OMP_WAIT_POLICY'])"]
    plain = {name: value for name, value in os.environ.items() if name != "OMP_WAIT_POLICY"}
    for given, policy in ((plain, "passive"), ({**plain, "OMP_WAIT_POLICY": "active"}, "active")):
        assert subprocess.run(probe, env=given, capture_output=True, text=True, check=False).stdout == f"{policy}\n"
