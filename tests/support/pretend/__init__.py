"""CUDA without a GPU: tensors that say they are on `cuda:0` and compute on the CPU, gsplat's own Python over plain torch, and counts.

A run in a process of its own finds tensors of two devices in one operation, as CUDA would, and counts kernels, bytes, copies and waits of
the host. It measures no time, and it does not run CUDA code. `start.py` starts such a process, `train.py` is what it runs.
"""
