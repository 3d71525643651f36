"""Interpolation in channels-last grids, for kernels: what VM and CP lookups share.

Grids are flat arrays; a lookup computes where its rows begin once, then loops over the channels.
"""

from __future__ import annotations

from backbones.kernels.compiler import float32, inline, int64
from backbones.kernels.simd import load

__all__ = ["CHUNK", "bilinear", "chunk", "corners", "linear", "node"]

# Samples of a task: enough to hide the cost of taking it, few enough to keep many threads busy.
CHUNK = 256


@inline
def chunk(task, count):  # type: ignore[no-untyped-def]
    """First and last (exclusive) sample of a task."""
    return task * CHUNK, min(count, (task + 1) * CHUNK)


@inline
def node(u, edge):  # type: ignore[no-untyped-def]
    """Node below coordinate ``u``, clamped to [0, 1], on ``edge`` nodes, and the share of the node above it.

    Not-a-number gives node 0 and a share that is not a number: nothing is read out of bounds, nothing is hidden.
    """
    if u < float32(0):
        u = float32(0)
    if u > float32(1):
        u = float32(1)
    scaled = u * float32(edge - 1)
    lower = min(int64(scaled), edge - 2) if scaled >= float32(0) else int64(0)
    return lower, scaled - float32(lower)


@inline
def corners(a, b):  # type: ignore[no-untyped-def]
    """Weights of the four nodes around a position in a cell of a plane: (0, 0), (0, 1), (1, 0), (1, 1)."""
    w11 = a * b
    w10 = a - w11
    w01 = b - w11
    return float32(1) - a - w01, w01, w10, w11


@inline
def bilinear(plane, i, across, down, w, c, like):  # type: ignore[no-untyped-def]
    """Channels from ``c`` on of a plane; the cell's first node begins at ``i``, the next along each axis after
    ``across`` and ``down`` elements."""
    i += c
    below = load(plane, i, like) * w[0] + load(plane, i + across, like) * w[1]
    i += down
    return below + load(plane, i, like) * w[2] + load(plane, i + across, like) * w[3]


@inline
def linear(line, i, channels, share, c, like):  # type: ignore[no-untyped-def]
    """Channels from ``c`` on of a line; the node below begins at ``i``."""
    i += c
    return load(line, i, like) * (float32(1) - share) + load(line, i + channels, like) * share
