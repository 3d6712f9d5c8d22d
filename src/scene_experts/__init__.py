"""Scene Experts: anchor-based 3D Gaussian splatting with a mixture of experts (MoE-GS, AAAI 2026), and its baselines."""

import os

# OpenMP's threads sleep between torch's operations instead of spinning, where torch is not loaded yet: spinning, they take the cores from
# the native library's own threads (4.7x slower training on two cores, ten times on a busy machine). It changes no number.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("KMP_BLOCKTIME", "0")

__version__ = "0.1.0"
