"""Interpolation in channels-last grids, for kernels.

Elements of a grid are counted in the order of memory. The processor is asked for the nodes of later samples while those
at hand are computed: along rays they are too far apart for it to guess.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from gridreg.ops.cpu.jit.compiler import inline
from gridreg.ops.cpu.jit.simd import load, prefetch
from gridreg.ops.cpu.jit.table import float32

# How far ahead nodes are asked for, in channels. Measured: with few channels memory needs some samples of time, with
# many more requests than the processor keeps open push each other out.
_AHEAD = 96
# Elements of a cache line.
_LINE = 16


class Cell(NamedTuple):
    """The four nodes of a plane around a sample.

    Args:
        first: element at which the channels of the lowest node begin.
        across, down: elements from there to the next node along the second and the first axis.
        weights: interpolation weights of the nodes (0, 0), (0, 1), (1, 0), (1, 1).
    """

    first: Any
    across: Any
    down: Any
    weights: Any


class Segment(NamedTuple):
    """The two nodes of a line around a sample.

    Args:
        first: element at which the channels of the lower node begin.
        across: elements from there to the upper node.
        fraction: interpolation weight of the upper node.
    """

    first: Any
    across: Any
    fraction: Any


@inline
def lookahead(read: int) -> int:
    """Number of samples ahead to ask for nodes of ``read`` channels."""
    return max(_AHEAD // max(read, 1), 1)


@inline
def prefetch_row(grid: Any, i: int, length: int) -> None:
    """Ask for ``length`` elements from ``i`` on."""
    for c in range(i, i + length, _LINE):
        prefetch(grid, c)


@inline
def prefetch_cell(plane: Any, first: int, across: int, down: int, read: int) -> None:
    """Ask for the first ``read`` channels of the four nodes of a cell of a plane."""
    prefetch_row(plane, first, across + read)
    prefetch_row(plane, first + down, across + read)


@inline
def cell_weights(a: Any, b: Any) -> tuple[Any, Any, Any, Any]:
    """Interpolation weights of a cell's nodes, from the fractions along both axes."""
    rest_a, rest_b = float32(1) - a, float32(1) - b
    return rest_a * rest_b, rest_a * b, a * rest_b, a * b


@inline
def bilinear(plane: Any, cell: Any, c: int, dtype_like: Any) -> Any:
    """Value of channels from ``c`` on of a plane in a `Cell`."""
    i, w = cell.first + c, cell.weights
    below = load(plane, i, dtype_like) * w[0] + load(plane, i + cell.across, dtype_like) * w[1]
    i += cell.down
    return below + load(plane, i, dtype_like) * w[2] + load(plane, i + cell.across, dtype_like) * w[3]


@inline
def linear(line: Any, segment: Any, c: int, dtype_like: Any) -> Any:
    """Value of channels from ``c`` on of a line in a `Segment`."""
    i, fraction = segment.first + c, segment.fraction
    return (
        load(line, i, dtype_like) * (float32(1) - fraction)
        + load(line, i + segment.across, dtype_like) * fraction
    )
