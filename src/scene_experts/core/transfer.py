"""Copy tensors to a device without synchronisation."""

from __future__ import annotations

import torch
from torch import Tensor


def upload(tensor: Tensor, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Tensor:
    """Return `tensor` on `device` with `dtype`. None keeps the current device or dtype.

    A copy from the CPU to CUDA uses page-locked memory, and the dtype is converted on the GPU. A
    copy from pageable memory would block the host until the GPU has finished all queued work. torch
    keeps page-locked memory and uses it again once the copy has ended.
    """
    if device is not None and torch.device(device).type == "cuda" and tensor.device.type == "cpu" and not tensor.requires_grad:
        return tensor.contiguous().pin_memory().to(device, non_blocking=True).to(dtype=dtype or tensor.dtype)
    return tensor.to(device=device, dtype=dtype)
