"""Compiled lookups of VM grids: gradients with respect to planes and lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gridreg.ops.cpu.counting_sort import ALONE, ENTRY, TASKS, felt, list_by_row, span
from gridreg.ops.cpu.grid_coordinates import axes
from gridreg.ops.cpu.interpolation import ahead, bilinear, corners, linear, prefetch_cell, prefetch_row
from gridreg.ops.cpu.jit.bfloat16 import get
from gridreg.ops.cpu.jit.compiler import (
    Kernel,
    float32,
    inline,
    int32,
    int64,
    integer,
    kernel,
    next_task,
    size,
    uint16,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, wide
from gridreg.ops.cpu.jit.workspace import room
from gridreg.ops.cpu.reductions import reduce_sum

__all__ = ["density_backward", "features_backward"]


@inline
def _add(
    grids: Any, at: Any, below: Any, down: Any, w: Any, share: Any, g: Any, to: Any, i: Any, j: Any, m: Any,
    channels: Any, like: Any,
) -> Any:  # fmt: skip
    """Add the gradient of some channels of a sample to four nodes of the plane and two of the line.

    All is read before anything is written: a processor holds a load back behind a store that agrees with it in the low
    bits of the address, and a gradient lies where its parameter does, but for these.
    """
    plane, line = grids
    to_lower, to_upper, to_line = to
    on_plane = linear(line, below, channels, share, like) * g
    on_line = bilinear(plane, at, channels, down, w, like) * g
    p00 = load(to_lower, i, like) + on_plane * w[0]
    p01 = load(to_lower, i + channels, like) + on_plane * w[1]
    p10 = load(to_upper, j, like) + on_plane * w[2]
    p11 = load(to_upper, j + channels, like) + on_plane * w[3]
    l0 = load(to_line, m, like) + on_line * (float32(1) - share)
    l1 = load(to_line, m + channels, like) + on_line * share
    store(to_lower, i, p00)
    store(to_lower, i + channels, p01)
    store(to_upper, j, p10)
    store(to_upper, j + channels, p11)
    store(to_line, m, l0)
    store(to_line, m + channels, l1)


@inline
def _serve(
    grids: Any, to_plane: Any, to: Any, keep: Any, base: Any, listing: Any, entries: Any, places: Any, columns: Any,
    channels: Any, read: Any, upstream: Any, summed: Any,
) -> Any:  # fmt: skip
    """Add the gradients of a range of entries; what is not kept goes to the first elements after its base."""
    nodes, shares = listing
    a, b, v, k = places
    blocks = read - read % LANES
    down = columns * channels
    far = ENTRY * ahead(read)
    first, last = entries
    for e in range(first, last, ENTRY):
        then = min(e + far, last - ENTRY)
        at = (int64(nodes[then + a]) * columns + int64(nodes[then + b])) * channels
        prefetch_cell(grids[0], at, channels, down, read)
        prefetch_cell(to_plane, at, channels, down, read)
        if not summed:
            prefetch_row(upstream, (3 * int64(nodes[then + 3]) + k) * channels, read)
        at = (int64(nodes[e + a]) * columns + int64(nodes[e + b])) * channels
        below, share = int64(nodes[e + v]) * channels, shares[e + v]
        w = corners(shares[e + a], shares[e + b])
        i, j = base[0] + (at & keep[0]), base[1] + ((at + down) & keep[1])
        m = base[2] + (below & keep[0])
        g = shares[e + 3]
        n = (3 * int64(nodes[e + 3]) + k) * channels
        for c in range(0, blocks, LANES):
            gc = wide() + g if summed else get(upstream, n + c, wide())
            _add(grids, at + c, below + c, down, w, share, gc, to, i + c, j + c, m + c, channels, wide())
        for c in range(blocks, read):
            gc = g if summed else get(upstream, n + c, one())
            _add(grids, at + c, below + c, down, w, share, gc, to, i + c, j + c, m + c, channels, one())


@inline
def _clear_line(table: Any, k: Any, part: Any, channels: Any) -> Any:
    """Set a task's copy of line ``k``'s gradient to 0, and return where it begins."""
    first = part * size(table, 12, 1)
    if k > 0:
        first += size(table, 4, 0)
    if k > 1:
        first += size(table, 5, 0)
    copies = vector(table, 12, float32)
    for i in range(first * channels, (first + size(table, 4 + k, 0)) * channels):
        copies[i] = float32(0)
    return first * channels


@inline
def _backward(table: Any, upstream: Any, summed: Any) -> Any:
    read, copies = integer(table, 7), vector(table, 12, float32)
    starts, nodes, shares = vector(table, 13, int64), vector(table, 14, int32), vector(table, 15, float32)
    waste = vector(table, 16, float32)
    channels, samples, stride = size(table, 4, 1), size(table, 0, 0), size(table, 13, 1)
    while True:
        task = next_task(table)
        if task < 0:
            break
        k, part = task // TASKS, task % TASKS
        grids = vector(table, 1 + k, float32), vector(table, 4 + k, float32)
        to_plane = vector(table, 9 + k, float32)
        line, bin_ = _clear_line(table, k, part, channels), 2 * task * channels
        a, b, v = axes(k)
        rows, columns = size(table, 1 + k, 0), size(table, 1 + k, 1)
        for where in range(3):
            first, last = span(starts, a * stride, rows, part, where)
            # What falls on rows of another task, which sees these samples too, goes to waste.
            low, high = where != 0, where != 2
            to = to_plane if low else waste, to_plane if high else waste, copies if low else waste
            keep = int64(-1 if low else 0), int64(-1 if high else 0)
            base = int64(0) if low else bin_, int64(0) if high else bin_, line if low else bin_
            entries = ENTRY * (a * samples + first), ENTRY * (a * samples + last)
            _serve(
                grids, to_plane, to, keep, base, (nodes, shares), entries, (a, b, v, k), columns, channels, read,
                upstream, summed,
            )  # fmt: skip


@kernel
def _density_backward(table: Any) -> None:
    """u, planes, lines, channels to read, upstream, plane gradients, line copies, listing, waste."""
    _backward(table, vector(table, 8, float32), True)


@kernel
def _features_backward(table: Any) -> None:
    """Arguments as of `_density_backward`."""
    _backward(table, vector(table, 8, float32), False)


@kernel
def _low_features_backward(table: Any) -> None:
    """Arguments as of `_density_backward`; upstream is bfloat16."""
    _backward(table, vector(table, 8, uint16), False)


def _run(
    compiled: Kernel,
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    read: int,
    upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:
    nodes = [line.shape[0] for line in lines]
    u, upstream = felt(u, upstream)
    listing = list_by_row(u, upstream, (nodes[2], nodes[1], nodes[0]), 2)
    copies = room("copies", TASKS, sum(nodes), lines[0].shape[1])
    waste = room("waste", 3 * TASKS, 2, lines[0].shape[1]).zero_()
    launch(
        compiled,
        3 * TASKS,
        u,
        *planes,
        *lines,
        read,
        upstream,
        *plane_gradients,
        copies,
        *listing,
        waste,
        alone=u.shape[0] < ALONE,
    )
    return list(torch.split(reduce_sum(copies), nodes))


def density_backward(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    read: int,
    upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:
    """Adds to ``plane_gradients`` in place and returns the gradients of the lines; upstream ``(N,)``."""
    return _run(_density_backward, u, planes, lines, read, upstream, plane_gradients)


def features_backward(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    read: int,
    upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:
    """Adds to ``plane_gradients`` in place and returns the gradients of the lines; upstream ``(N, 3 C)``."""
    low = upstream.dtype == torch.bfloat16
    return _run(
        _low_features_backward if low else _features_backward,
        u,
        planes,
        lines,
        read,
        upstream,
        plane_gradients,
    )
