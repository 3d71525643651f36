"""Compiled lookups of VM grids: values."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from backbones.kernels.compiler import float32, inline, integer, kernel, next_task, size, vector
from backbones.kernels.lookup import CHUNK, bilinear, chunk, corners, linear, node
from backbones.kernels.simd import LANES, one, store, total, wide
from backbones.kernels.threading import launch

__all__ = ["density", "features"]


@inline
def _place(u, n, a, b, v, rows, columns, nodes, channels):  # type: ignore[no-untyped-def]
    """Of sample ``n``: where its rows begin in the plane and the line, and the weights."""
    i, share_a = node(u[3 * n + a], rows)
    j, share_b = node(u[3 * n + b], columns)
    k, share = node(u[3 * n + v], nodes)
    return (i * columns + j) * channels, corners(share_a, share_b), k * channels, share


@inline
def _product(plane, line, at, down, w, below, share, channels, c, like):  # type: ignore[no-untyped-def]
    value = bilinear(plane, at, channels, down, w, c, like)
    return value * linear(line, below, channels, share, c, like)


@inline
def _dot(u, n, a, b, v, plane, line, rows, columns, nodes, channels, blocks, channels_read):  # type: ignore[no-untyped-def]
    """Sum over the open channels of plane times line at sample ``n``."""
    at, w, below, share = _place(u, n, a, b, v, rows, columns, nodes, channels)
    down = columns * channels
    lanes = wide()
    for c in range(0, blocks, LANES):
        lanes = lanes + _product(plane, line, at, down, w, below, share, channels, c, wide())
    value = total(lanes)
    for c in range(blocks, channels_read):
        value += _product(plane, line, at, down, w, below, share, channels, c, one())
    return value


@kernel
def _density(table):  # type: ignore[no-untyped-def]
    """u, three planes, three lines, channels to read, out."""
    u = vector(table, 0, float32)
    plane0, plane1, plane2 = vector(table, 1, float32), vector(table, 2, float32), vector(table, 3, float32)
    line0, line1, line2 = vector(table, 4, float32), vector(table, 5, float32), vector(table, 6, float32)
    read = integer(table, 7)
    out = vector(table, 8, float32)
    x, y, z, channels = size(table, 6, 0), size(table, 5, 0), size(table, 4, 0), size(table, 4, 1)
    blocks = read - read % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        first, last = chunk(task, out.shape[0])
        for n in range(first, last):
            value = _dot(u, n, 0, 1, 2, plane0, line0, x, y, z, channels, blocks, read)
            value += _dot(u, n, 0, 2, 1, plane1, line1, x, z, y, channels, blocks, read)
            value += _dot(u, n, 1, 2, 0, plane2, line2, y, z, x, channels, blocks, read)
            out[n] = value


@inline
def _write(u, n, a, b, v, plane, line, rows, columns, nodes, channels, blocks, read, out, to):  # type: ignore[no-untyped-def]
    """Plane times line at sample ``n`` to ``out`` from element ``to`` on."""
    at, w, below, share = _place(u, n, a, b, v, rows, columns, nodes, channels)
    down = columns * channels
    for c in range(0, blocks, LANES):
        store(out, to + c, _product(plane, line, at, down, w, below, share, channels, c, wide()))
    for c in range(blocks, read):
        store(out, to + c, _product(plane, line, at, down, w, below, share, channels, c, one()))
    for c in range(read, channels):
        out[to + c] = float32(0)


@kernel
def _features(table):  # type: ignore[no-untyped-def]
    """u, three planes, three lines, channels to read, out."""
    u = vector(table, 0, float32)
    plane0, plane1, plane2 = vector(table, 1, float32), vector(table, 2, float32), vector(table, 3, float32)
    line0, line1, line2 = vector(table, 4, float32), vector(table, 5, float32), vector(table, 6, float32)
    read = integer(table, 7)
    out = vector(table, 8, float32)
    x, y, z, channels = size(table, 6, 0), size(table, 5, 0), size(table, 4, 0), size(table, 4, 1)
    blocks = read - read % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        first, last = chunk(task, size(table, 8, 0))
        for n in range(first, last):
            to = 3 * n * channels
            _write(u, n, 0, 1, 2, plane0, line0, x, y, z, channels, blocks, read, out, to)
            to += channels
            _write(u, n, 0, 2, 1, plane1, line1, x, z, y, channels, blocks, read, out, to)
            to += channels
            _write(u, n, 1, 2, 0, plane2, line2, y, z, x, channels, blocks, read, out, to)


def density(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N,)``; all contiguous float32 on the CPU, ``read`` the number of channels to use."""
    out = torch.empty(u.shape[0])
    launch(_density, -(-u.shape[0] // CHUNK), u, *planes, *lines, read, out)
    return out


def features(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N, 3 C)``; arguments as for `density`."""
    out = torch.empty(u.shape[0], 3 * lines[0].shape[1])
    launch(_features, -(-u.shape[0] // CHUNK), u, *planes, *lines, read, out)
    return out
