"""The grid coordinates of a batch of samples, for kernels."""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.compiler import exact, inline
from gridreg.ops.cpu.jit.simd import load, scalar_zero
from gridreg.ops.cpu.jit.table import Vector, float32, int32, int64

# Samples of a batch: their coordinates fit into the first-level cache.
BATCH = 256
# One number for each axis of each of them.
COORDINATES = 3 * BATCH


@inline
def batch(task: int, count: int) -> tuple[int, int]:
    """First and last (exclusive) of the samples of a task."""
    return task * BATCH, min(count, (task + 1) * BATCH)


@inline
def axes(k: int) -> tuple[int, int, int]:
    """The two axes of plane ``k``, and the axis of line ``k``."""
    return 1 if k == 2 else 0, 1 if k == 0 else 2, 2 - k


# Every operation rounded on its own, as in the plain version: on 300 nodes the last bit of a product is 3e-5 of a cell.
@exact
def node(u: Any, edge: int) -> tuple[Any, Any]:
    """Node below coordinate ``u``, clamped to [0, 1], on ``edge`` nodes, and the fraction of the way to the next one.

    Not-a-number gives node 0 and a fraction that is not a number: nothing is read out of bounds, nothing is hidden.
    """
    u = float32(0) if u < float32(0) else u
    u = float32(1) if u > float32(1) else u
    scaled = u * float32(edge - 1)
    lower = min(int32(scaled), int32(edge - 2)) if scaled >= float32(0) else int32(0)
    return lower, scaled - float32(lower)


@inline
def locate(
    nodes: Vector[int32], fractions: Vector[float32], u: Vector[float32], first: int, count: int,
    shape: tuple[int, int, int],
) -> None:  # fmt: skip
    """Write node below and fraction along each of the three axes for ``count`` samples from ``first`` on.

    ``nodes`` and ``fractions`` have `COORDINATES` elements, those of axis a from ``a * BATCH`` on.
    """
    for axis in range(3):
        edge = int64(shape[axis])
        for q in range(count):
            lower, fraction = node(load(u, 3 * (first + q) + axis, scalar_zero()), edge)
            nodes[axis * BATCH + q] = lower
            fractions[axis * BATCH + q] = fraction
