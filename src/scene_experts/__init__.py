"""Scene Experts: anchor-based 3D Gaussian splatting with a mixture of experts (MoE-GS, AAAI 2026), and its baselines."""

__version__ = "0.1.0"
