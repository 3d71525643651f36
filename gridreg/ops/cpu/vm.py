"""Compiled lookups of VM grids: values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gridreg.ops.cpu.grid_coordinates import BATCH, COORDINATES, axes, batch, locate
from gridreg.ops.cpu.interpolation import (
    Cell,
    Segment,
    bilinear,
    cell_weights,
    linear,
    lookahead,
    prefetch_cell,
)
from gridreg.ops.cpu.jit.compiler import inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, scalar_zero, store, total, vector_zero
from gridreg.ops.cpu.jit.table import Cube, Matrix, Vector, float32, int32, int64, scratch, uint16


class Batch(NamedTuple):
    """Samples placed on the grid: nodes and fractions as of `locate`, first element of their cells in each plane."""

    nodes: Any
    fractions: Any
    cells: Any


@inline
def shape_of(lines: Any) -> tuple[int, int, int]:
    """Nodes along x, y and z; line k lies along axis 2 - k."""
    return lines[2].shape[0], lines[1].shape[0], lines[0].shape[0]


@inline
def _product(plane: Any, line: Any, cell: Any, segment: Any, c: int, dtype_like: Any) -> Any:
    return bilinear(plane, cell, c, dtype_like) * linear(line, segment, c, dtype_like)


@inline
def _sum(plane: Any, line: Any, cell: Any, segment: Any, read: int) -> Any:
    """Sum over channels of plane times line."""
    blocks = read - read % LANES
    lanes = vector_zero()
    for c in range(0, blocks, LANES):
        lanes = lanes + _product(plane, line, cell, segment, c, vector_zero())
    value = total(lanes)
    for c in range(blocks, read):
        value += _product(plane, line, cell, segment, c, scalar_zero())
    return value


@inline
def _write(plane: Any, line: Any, cell: Any, segment: Any, read: int, out: Any, to: int) -> None:
    """Plane times line to ``out`` from element ``to`` on; 0 for channels that are not read."""
    blocks = read - read % LANES
    for c in range(0, blocks, LANES):
        store(out, to + c, _product(plane, line, cell, segment, c, vector_zero()))
    for c in range(blocks, read):
        store(out, to + c, _product(plane, line, cell, segment, c, scalar_zero()))
    for c in range(read, cell.across):
        store(out, to + c, scalar_zero())


@inline
def find_cells(samples: Any, count: int, shape: tuple[int, int, int], channels: int) -> None:
    """Write where the cells of a batch begin in the three planes."""
    for k in range(3):
        a, b, _ = axes(k)
        columns, width = int32(shape[b]), int32(channels)
        for q in range(count):
            node = samples.nodes[a * BATCH + q] * columns + samples.nodes[b * BATCH + q]
            samples.cells[k * BATCH + q] = node * width


# Arrays come as arguments of their own: numba counts references to those in a tuple, at each call.
@inline
def look_up(
    plane: Any, line: Any, k: int, nodes: Any, fractions: Any, cells: Any, part: tuple[int, int, int], read: int,
    out: Any, n: int, summed: bool,
) -> None:  # fmt: skip
    """Product of plane and line ``k`` at a part (start, stop, count) of a batch whose first sample is ``n``.

    If ``summed``, its sum over channels is added to ``out``, else its channels are written one after another.
    """
    start, stop, count = part
    channels, (a, b, v) = line.shape[1], axes(k)
    down, far = plane.shape[1] * channels, lookahead(read)
    first, a, b, v = k * BATCH, a * BATCH, b * BATCH, v * BATCH
    for q in range(start, stop):
        if q + far < count:
            prefetch_cell(plane, int64(cells[first + q + far]), channels, down, read)
        weights = cell_weights(fractions[a + q], fractions[b + q])
        cell = Cell(int64(cells[first + q]), channels, down, weights)
        segment = Segment(int64(nodes[v + q]) * channels, channels, fractions[v + q])
        if summed:
            value = _sum(plane, line, cell, segment, read)
            out[n + q] = value if k == 0 else out[n + q] + value
        else:
            _write(plane, line, cell, segment, read, out, (3 * (n + q) + k) * channels)


@inline
def _forward(
    task: int, u: Any, planes: Any, lines: Any, read: int, samples: Any, out: Any, summed: bool
) -> None:
    first, last = batch(task, u.shape[0])
    count, shape = last - first, shape_of(lines)
    locate(samples.nodes, samples.fractions, u, first, count, shape)
    find_cells(samples, count, shape, lines[0].shape[1])
    for k in range(3):
        look_up(
            planes[k], lines[k], k, samples.nodes, samples.fractions, samples.cells, (0, count, count), read, out,
            first, summed,
        )  # fmt: skip


@kernel
def _density(
    task: int, u: Matrix[float32], xy: Cube[float32], xz: Cube[float32], yz: Cube[float32], z: Matrix[float32],
    y: Matrix[float32], x: Matrix[float32], read: int64, out: Vector[float32],
) -> None:  # fmt: skip
    """Sum over planes, lines and channels."""
    samples = Batch(scratch(COORDINATES, int32), scratch(COORDINATES, float32), scratch(COORDINATES, int32))
    _forward(task, u, (xy, xz, yz), (z, y, x), read, samples, out, True)


@kernel
def _features(
    task: int, u: Matrix[float32], xy: Cube[float32], xz: Cube[float32], yz: Cube[float32], z: Matrix[float32],
    y: Matrix[float32], x: Matrix[float32], read: int64, out: Vector[float32],
) -> None:  # fmt: skip
    """Products of planes and lines, channel by channel."""
    samples = Batch(scratch(COORDINATES, int32), scratch(COORDINATES, float32), scratch(COORDINATES, int32))
    _forward(task, u, (xy, xz, yz), (z, y, x), read, samples, out, False)


@kernel
def _bf16_features(
    task: int, u: Matrix[float32], xy: Cube[float32], xz: Cube[float32], yz: Cube[float32], z: Matrix[float32],
    y: Matrix[float32], x: Matrix[float32], read: int64, out: Vector[uint16],
) -> None:  # fmt: skip
    """`_features`, rounded to bfloat16."""
    samples = Batch(scratch(COORDINATES, int32), scratch(COORDINATES, float32), scratch(COORDINATES, int32))
    _forward(task, u, (xy, xz, yz), (z, y, x), read, samples, out, False)


def density(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N,)``; all contiguous float32 on the CPU, ``read`` the number of channels to use."""
    out = torch.empty(u.shape[0])
    launch(_density, -(-u.shape[0] // BATCH), u, *planes, *lines, read, out)
    return out


def features(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    read: int,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """``(N, 3 C)`` of ``dtype``, float32 or bfloat16; arguments as for `density`."""
    out = torch.empty(u.shape[0], 3 * lines[0].shape[1], dtype=dtype)
    compiled = _bf16_features if dtype == torch.bfloat16 else _features
    launch(compiled, -(-u.shape[0] // BATCH), u, *planes, *lines, read, out)
    return out
