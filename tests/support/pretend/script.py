"""Run a Python script with tensors that pretend to be on CUDA.

python -m support.pretend.script benchmarks/kernels_cuda.py --count 50   # see start.make_environment

The folder of the script must be on PYTHONPATH.
"""

import os
import runpy
import sys

from peer_cuda import device
from support.pretend.setup import launch, prepare
from support.pretend.tensors import Pretending


def main(words: list[str]) -> None:
    prepare()
    device.launch = launch
    sys.argv = words
    with Pretending():
        runpy.run_path(words[0], run_name="__main__")
    sys.stdout.flush()
    os._exit(0)  # autograd's thread of a device that is not there cannot be joined


if __name__ == "__main__":
    main(sys.argv[1:])
