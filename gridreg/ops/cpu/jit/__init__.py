"""Compiling and launching kernels: what stands between them and numba."""
