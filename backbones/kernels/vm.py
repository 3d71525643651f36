"""Compiled lookups of VM grids: values."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from backbones.kernels.compiler import float32, inline, int32, int64, integer, kernel, next_task, size, vector
from backbones.kernels.lookup import ahead, bilinear, corners, linear, prefetch_cell
from backbones.kernels.places import BATCH, axes, batch, find, new_places
from backbones.kernels.simd import LANES, one, store, total, wide
from backbones.kernels.threading import launch

__all__ = ["density", "features", "plane_sum"]


@inline
def _product(grids: Any, at: Any, below: Any, channels: Any, down: Any, w: Any, share: Any, like: Any) -> Any:
    plane, line = grids
    return bilinear(plane, at, channels, down, w, like) * linear(line, below, channels, share, like)


@inline
def plane_sum(
    grids: Any, at: Any, below: Any, channels: Any, down: Any, w: Any, share: Any, read: Any
) -> Any:
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
        store(out, to + c, _product(grids, at + c, below + c, channels, down, w, share, wide()))
    for c in range(blocks, read):
        store(out, to + c, _product(grids, at + c, below + c, channels, down, w, share, one()))
    for c in range(read, channels):
        out[to + c] = float32(0)


@inline
def _forward(table: Any, summed: Any) -> Any:
    u, read, out = vector(table, 0, float32), integer(table, 7), vector(table, 8, float32)
    samples, channels, far = size(table, 0, 0), size(table, 4, 1), ahead(read)
    shape = size(table, 6, 0), size(table, 5, 0), size(table, 4, 0)
    places = new_places()
    nodes, shares = places
    starts = np.empty(BATCH, int32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        first, last = batch(task, samples)
        count = last - first
        find(places, u, first, count, shape)
        for k in range(3):
            grids = vector(table, 1 + k, float32), vector(table, 4 + k, float32)
            a, b, v = axes(k)
            a, b, v = a * BATCH, b * BATCH, v * BATCH
            columns = size(table, 1 + k, 1)
            down = columns * channels
            for q in range(count):
                starts[q] = (nodes[a + q] * int32(columns) + nodes[b + q]) * int32(channels)
            for q in range(count):
                if q + far < count:
                    prefetch_cell(grids[0], int64(starts[q + far]), channels, down, read)
                at, below, share = int64(starts[q]), int64(nodes[v + q]) * channels, shares[v + q]
                w = corners(shares[a + q], shares[b + q])
                n = first + q
                if summed:
                    value = plane_sum(grids, at, below, channels, down, w, share, read)
                    out[n] = value if k == 0 else out[n] + value
                else:
                    to = (3 * n + k) * channels
                    _write(grids, at, below, channels, down, w, share, read, out, to)


@kernel
def _density(table: Any) -> None:
    """u, three planes, three lines, channels to read, out."""
    _forward(table, True)


@kernel
def _features(table: Any) -> None:
    """u, three planes, three lines, channels to read, out."""
    _forward(table, False)


def density(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N,)``; all contiguous float32 on the CPU, ``read`` the number of channels to use."""
    out = torch.empty(u.shape[0])
    launch(_density, -(-u.shape[0] // BATCH), u, *planes, *lines, read, out)
    return out


def features(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N, 3 C)``; arguments as for `density`."""
    out = torch.empty(u.shape[0], 3 * lines[0].shape[1])
    launch(_features, -(-u.shape[0] // BATCH), u, *planes, *lines, read, out)
    return out
