"""A CUDA runtime and driver without a device, in C, for host times and rehearsals on a machine without a GPU.

torch for CUDA, gsplat and Triton run as on a GPU: torch's dispatch, autograd's threads, the caching allocator and Triton's launcher take
their real way and end in these functions. Kernels do nothing, memory reads as zeros, and everything is counted. `start.py` compiles the
library and starts a process with it; `counts.py` reads it in that process.
"""
