"""Tensors to a device without making the host wait for it."""

from __future__ import annotations

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
    """`tensor` on `device`, of `dtype` (None: as it is).

    From the CPU to CUDA it goes through page-locked memory in its own dtype and is converted there: a copy from other memory would make the
    host wait until the device has done all it was given, and a conversion on the way would be the CPU's.
    """
    if device is not None and torch.device(device).type == "cuda" and tensor.device.type == "cpu" and not tensor.requires_grad:
        return tensor.contiguous().pin_memory().to(device, non_blocking=True).to(dtype=dtype or tensor.dtype)
    return tensor.to(device=device, dtype=dtype)
