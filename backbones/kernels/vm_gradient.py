"""Compiled lookups of VM grids: gradients with respect to planes and lines."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from backbones.kernels.compiler import (
    float32,
    inline,
    int32,
    int64,
    integer,
    kernel,
    next_task,
    size,
    vector,
)
from backbones.kernels.lookup import bilinear, corners, linear, node
from backbones.kernels.rows import TASKS, owned_rows, sort_by_row
from backbones.kernels.simd import LANES, add_to, load, one, wide
from backbones.kernels.threading import launch

__all__ = ["density_backward", "features_backward"]


@inline
def _same(upstream, n, width, c, like):  # type: ignore[no-untyped-def]
    """Gradient of a sum over channels: the same for all of them."""
    return upstream[n]


@inline
def _each(upstream, n, width, c, like):  # type: ignore[no-untyped-def]
    """Gradient of concatenated channels."""
    return load(upstream, n * width + c, like)


@inline
def _add_rows(
    gradient, line, upstream, get, n, width, first, at, down, w, below, share, lower, upper, channels, c, like
):  # type: ignore[no-untyped-def]
    """Add to the four nodes of the plane around sample ``n``: to those of the lower row, the upper row or both."""
    value = linear(line, below, channels, share, c, like) * get(upstream, n, width, first + c, like)
    if lower:
        add_to(gradient, at + c, value * w[0])
        add_to(gradient, at + channels + c, value * w[1])
    if upper:
        add_to(gradient, at + down + c, value * w[2])
        add_to(gradient, at + down + channels + c, value * w[3])


@inline
def _plane(
    u,
    a,
    b,
    v,
    line,
    gradient,
    upstream,
    get,
    width,
    first,
    rows,
    columns,
    nodes,
    channels,
    read,
    order,
    starts,
    part,
):  # type: ignore[no-untyped-def]
    """Gradient of the rows that task ``part`` owns."""
    start, stop = owned_rows(starts, rows, part, TASKS)
    blocks = read - read % LANES
    down = columns * channels
    for row in range(max(start - 1, 0), stop if stop > start else 0):
        lower, upper = row >= start, row + 1 < stop
        for q in range(starts[row], starts[row + 1]):
            n = int64(order[q])
            share_a = node(u[3 * n + a], rows)[1]
            j, share_b = node(u[3 * n + b], columns)
            k, share = node(u[3 * n + v], nodes)
            w = corners(share_a, share_b)
            at = (row * columns + j) * channels
            for c in range(0, blocks, LANES):
                _add_rows(
                    gradient,
                    line,
                    upstream,
                    get,
                    n,
                    width,
                    first,
                    at,
                    down,
                    w,
                    k * channels,
                    share,
                    lower,
                    upper,
                    channels,
                    c,
                    wide(),
                )
            for c in range(blocks, read):
                _add_rows(
                    gradient,
                    line,
                    upstream,
                    get,
                    n,
                    width,
                    first,
                    at,
                    down,
                    w,
                    k * channels,
                    share,
                    lower,
                    upper,
                    channels,
                    c,
                    one(),
                )


@inline
def _add_line(plane, gradient, upstream, get, n, width, first, at, down, w, below, share, channels, c, like):  # type: ignore[no-untyped-def]
    value = bilinear(plane, at, channels, down, w, c, like) * get(upstream, n, width, first + c, like)
    add_to(gradient, below + c, value * (float32(1) - share))
    add_to(gradient, below + channels + c, value * share)


@inline
def _line(u, n, a, b, v, plane, gradient, upstream, get, width, first, rows, columns, nodes, channels, read):  # type: ignore[no-untyped-def]
    """Gradient of one line from one sample, into the task's own copy."""
    i, share_a = node(u[3 * n + a], rows)
    j, share_b = node(u[3 * n + b], columns)
    k, share = node(u[3 * n + v], nodes)
    w = corners(share_a, share_b)
    at, down, below = (i * columns + j) * channels, columns * channels, k * channels
    blocks = read - read % LANES
    for c in range(0, blocks, LANES):
        _add_line(
            plane, gradient, upstream, get, n, width, first, at, down, w, below, share, channels, c, wide()
        )
    for c in range(blocks, read):
        _add_line(
            plane, gradient, upstream, get, n, width, first, at, down, w, below, share, channels, c, one()
        )


@inline
def _backward(table, get, step):  # type: ignore[no-untyped-def]
    u = vector(table, 0, float32)
    plane0, plane1, plane2 = vector(table, 1, float32), vector(table, 2, float32), vector(table, 3, float32)
    line0, line1, line2 = vector(table, 4, float32), vector(table, 5, float32), vector(table, 6, float32)
    read = integer(table, 7)
    upstream = vector(table, 8, float32)
    to_plane0, to_plane1, to_plane2 = (
        vector(table, 9, float32),
        vector(table, 10, float32),
        vector(table, 11, float32),
    )
    copies = vector(table, 12, float32)
    orders, all_starts = vector(table, 13, int32), vector(table, 14, int64)
    active = vector(table, 15, float32)
    x, y, z, channels = size(table, 6, 0), size(table, 5, 0), size(table, 4, 0), size(table, 4, 1)
    samples, stride, width = size(table, 0, 0), size(table, 14, 1), size(table, 8, 1)
    length = (x + y + z) * channels
    while True:
        task = next_task(table)
        if task < 0:
            break
        kind, part = task // TASKS, task % TASKS
        if kind < 3:
            order = orders[kind * samples : (kind + 1) * samples]
            starts = all_starts[kind * stride : (kind + 1) * stride]
            if kind == 0:
                _plane(
                    u,
                    0,
                    1,
                    2,
                    line0,
                    to_plane0,
                    upstream,
                    get,
                    width,
                    0,
                    x,
                    y,
                    z,
                    channels,
                    read,
                    order,
                    starts,
                    part,
                )
            elif kind == 1:
                _plane(
                    u,
                    0,
                    2,
                    1,
                    line1,
                    to_plane1,
                    upstream,
                    get,
                    width,
                    step,
                    x,
                    z,
                    y,
                    channels,
                    read,
                    order,
                    starts,
                    part,
                )
            else:
                _plane(
                    u,
                    1,
                    2,
                    0,
                    line2,
                    to_plane2,
                    upstream,
                    get,
                    width,
                    2 * step,
                    y,
                    z,
                    x,
                    channels,
                    read,
                    order,
                    starts,
                    part,
                )
        else:
            copy = copies[part * length : (part + 1) * length]
            copy[:] = float32(0)
            to_line0 = copy[: z * channels]
            to_line1 = copy[z * channels : (z + y) * channels]
            to_line2 = copy[(z + y) * channels :]
            for n in range(part * samples // TASKS, (part + 1) * samples // TASKS):
                if active[n] == float32(0):
                    continue
                _line(u, n, 0, 1, 2, plane0, to_line0, upstream, get, width, 0, x, y, z, channels, read)
                _line(u, n, 0, 2, 1, plane1, to_line1, upstream, get, width, step, x, z, y, channels, read)
                _line(
                    u, n, 1, 2, 0, plane2, to_line2, upstream, get, width, 2 * step, y, z, x, channels, read
                )


@kernel
def _density_backward(table):  # type: ignore[no-untyped-def]
    """u, planes, lines, channels, upstream, plane gradients, line copies, order, starts, active."""
    _backward(table, _same, 0)


@kernel
def _features_backward(table):  # type: ignore[no-untyped-def]
    """Arguments as of `_density_backward`."""
    _backward(table, _each, size(table, 4, 1))


def _run(compiled, u, planes, lines, read, upstream, plane_gradients, active):  # type: ignore[no-untyped-def]
    order, starts = sort_by_row(u, active, [p.shape[0] for p in planes])
    copies = torch.empty(TASKS, sum(line.shape[0] for line in lines), lines[0].shape[1])
    launch(
        compiled,
        4 * TASKS,
        u,
        *planes,
        *lines,
        read,
        upstream,
        *plane_gradients,
        copies,
        order,
        starts,
        active,
    )
    return list(copies.sum(0).split([line.shape[0] for line in lines]))


def density_backward(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    read: int,
    upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:
    """Adds to ``plane_gradients`` in place and returns the gradients of the lines."""
    return _run(_density_backward, u, planes, lines, read, upstream, plane_gradients, upstream)


def features_backward(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    read: int,
    upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:
    """Adds to ``plane_gradients`` in place and returns the gradients of the lines."""
    return _run(_features_backward, u, planes, lines, read, upstream, plane_gradients, torch.ones(u.shape[0]))
