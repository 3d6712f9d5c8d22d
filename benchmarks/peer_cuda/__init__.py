"""What the peer of the CUDA benchmarks uses of this project, as it was at commit da16e27.

The peer is plain gsplat with the loss, the optimiser and the copies to the device that its first
comparison on a GPU had (docs/performance.md). Those of the project get faster; these copies do not,
so that a ratio to the peer means the same at every commit. Change nothing here.
"""
