"""Interpolation in channels-last grids, for kernels.

Grids are flat arrays. The processor is asked for the rows of samples ahead while those at hand are computed: along rays
they are too far apart for it to guess.
"""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.compiler import float32, inline
from gridreg.ops.cpu.jit.simd import load, prefetch

__all__ = ["ahead", "bilinear", "corners", "linear", "prefetch_cell", "prefetch_row"]

# How far ahead rows are asked for, in channels. Measured: with few channels memory needs some samples of time, with
# many more requests than the processor keeps open push each other out.
_AHEAD = 96
# Elements of a cache line.
_LINE = 16


@inline
def ahead(read: Any) -> Any:
    """How many samples ahead to ask for rows of ``read`` channels."""
    return max(_AHEAD // max(read, 1), 1)


@inline
def prefetch_row(grid: Any, i: Any, length: Any) -> Any:
    """Ask for ``length`` elements from ``i`` on."""
    for c in range(i, i + length, _LINE):
        prefetch(grid, c)


@inline
def prefetch_cell(plane: Any, i: Any, channels: Any, down: Any, read: Any) -> Any:
    """Ask for the first ``read`` channels of the four nodes of a cell of a plane."""
    prefetch_row(plane, i, channels + read)
    prefetch_row(plane, i + down, channels + read)


@inline
def corners(a: Any, b: Any) -> Any:
    """Weights of the four nodes around a position in a cell of a plane: (0, 0), (0, 1), (1, 0), (1, 1)."""
    rest_a, rest_b = float32(1) - a, float32(1) - b
    return rest_a * rest_b, rest_a * b, a * rest_b, a * b


@inline
def bilinear(plane: Any, i: Any, across: Any, down: Any, w: Any, like: Any) -> Any:
    """Channels of a plane; those of the cell's first node begin at ``i``, those of the nodes along each axis
    ``across`` and ``down`` elements further."""
    below = load(plane, i, like) * w[0] + load(plane, i + across, like) * w[1]
    i += down
    return below + load(plane, i, like) * w[2] + load(plane, i + across, like) * w[3]


@inline
def linear(line: Any, i: Any, across: Any, share: Any, like: Any) -> Any:
    """Channels of a line; those of the node below begin at ``i``, those of the node above ``across`` further."""
    return load(line, i, like) * (float32(1) - share) + load(line, i + across, like) * share
