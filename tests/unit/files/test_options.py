"""The options of an export as one value."""

import subprocess
import sys


def test_the_help_needs_no_torch():
    code = "import sys, scene_experts.files.options, scene_experts.files.registry; print('torch' in sys.modules, 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == ["False", "False"]
