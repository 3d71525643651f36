"""Compiled lookups of VM grids: values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gridreg.ops.cpu.grid_coordinates import BATCH, PLACES, axes, batch, find
from gridreg.ops.cpu.interpolation import ahead, bilinear, corners, linear, prefetch_cell
from gridreg.ops.cpu.jit.bfloat16 import put
from gridreg.ops.cpu.jit.compiler import (
    float32,
    inline,
    int32,
    int64,
    integer,
    kernel,
    next_task,
    scratch,
    size,
    uint16,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, one, total, wide

__all__ = ["density", "features", "find_cells", "look_up", "low_features"]


@inline
def _product(grids: Any, at: Any, below: Any, channels: Any, down: Any, w: Any, share: Any, like: Any) -> Any:
    plane, line = grids
    return bilinear(plane, at, channels, down, w, like) * linear(line, below, channels, share, like)


@inline
def _sum(grids: Any, at: Any, below: Any, channels: Any, down: Any, w: Any, share: Any, read: Any) -> Any:
    """Sum over channels of plane times line; ``at`` and ``below`` are their first elements, ``down`` a row's length."""
    blocks = read - read % LANES
    lanes = wide()
    for c in range(0, blocks, LANES):
        lanes = lanes + _product(grids, at + c, below + c, channels, down, w, share, wide())
    value = total(lanes)
    for c in range(blocks, read):
        value += _product(grids, at + c, below + c, channels, down, w, share, one())
    return value


@inline
def _write(
    grids: Any,
    at: Any,
    below: Any,
    channels: Any,
    down: Any,
    w: Any,
    share: Any,
    read: Any,
    out: Any,
    to: Any,
) -> Any:
    """Plane times line to ``out`` from element ``to`` on; 0 for channels that are not read."""
    blocks = read - read % LANES
    for c in range(0, blocks, LANES):
        put(out, to + c, _product(grids, at + c, below + c, channels, down, w, share, wide()))
    for c in range(blocks, read):
        put(out, to + c, _product(grids, at + c, below + c, channels, down, w, share, one()))
    for c in range(read, channels):
        put(out, to + c, one())


@inline
def find_cells(cells: Any, nodes: Any, count: Any, shape: Any, channels: Any) -> Any:
    """Write where the cells of a batch begin in the three planes."""
    for k in range(3):
        a, b, _ = axes(k)
        columns, width = int32(shape[b]), int32(channels)
        for q in range(count):
            cells[k * BATCH + q] = (nodes[a * BATCH + q] * columns + nodes[b * BATCH + q]) * width


@inline
def look_up(
    grids: Any, k: Any, cells: Any, places: Any, part: Any, shape: Any, channels: Any, read: Any, out: Any, n: Any,
    summed: Any,
) -> Any:  # fmt: skip
    """Product of plane and line ``k`` at a part (start, stop, count) of a batch whose first sample is ``n``.

    If ``summed``, its sum over channels is added to ``out``, else its channels are written to their place.
    """
    nodes, shares = places
    start, stop, count = part
    a, b, v = axes(k)
    down, far = shape[b] * channels, ahead(read)
    cell = k * BATCH
    a, b, v = a * BATCH, b * BATCH, v * BATCH
    for q in range(start, stop):
        if q + far < count:
            prefetch_cell(grids[0], int64(cells[cell + q + far]), channels, down, read)
        at, below, share = int64(cells[cell + q]), int64(nodes[v + q]) * channels, shares[v + q]
        w = corners(shares[a + q], shares[b + q])
        if summed:
            value = _sum(grids, at, below, channels, down, w, share, read)
            out[n + q] = value if k == 0 else out[n + q] + value
        else:
            _write(grids, at, below, channels, down, w, share, read, out, (3 * (n + q) + k) * channels)


@inline
def _forward(table: Any, out: Any, summed: Any) -> Any:
    u, read = vector(table, 0, float32), integer(table, 7)
    samples, channels = size(table, 0, 0), size(table, 4, 1)
    shape = size(table, 6, 0), size(table, 5, 0), size(table, 4, 0)
    places = scratch(PLACES, int32), scratch(PLACES, float32)
    cells = scratch(PLACES, int32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        first, last = batch(task, samples)
        count = last - first
        find(places, u, first, count, shape)
        find_cells(cells, places[0], count, shape, channels)
        for k in range(3):
            grids = vector(table, 1 + k, float32), vector(table, 4 + k, float32)
            look_up(grids, k, cells, places, (0, count, count), shape, channels, read, out, first, summed)


@kernel
def _density(table: Any) -> None:
    """u, three planes, three lines, channels to read, out."""
    _forward(table, vector(table, 8, float32), True)


@kernel
def _features(table: Any) -> None:
    """u, three planes, three lines, channels to read, out."""
    _forward(table, vector(table, 8, float32), False)


@kernel
def _low_features(table: Any) -> None:
    """Arguments as of `_features`; out is bfloat16."""
    _forward(table, vector(table, 8, uint16), False)


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
    compiled = _low_features if dtype == torch.bfloat16 else _features
    launch(compiled, -(-u.shape[0] // BATCH), u, *planes, *lines, read, out)
    return out


def low_features(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int) -> Tensor:
    """`features` in bfloat16."""
    return features(u, planes, lines, read, torch.bfloat16)
