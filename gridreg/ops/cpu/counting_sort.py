"""Who may write where: samples sorted by the row of the grid that they touch.

Adding gradients to a grid in parallel needs owners. Channels as owners split cache lines between threads; here a task
owns whole rows. A counting sort lists the samples by the row below them, in sample order within a row. A task takes a
range of rows with its share of the samples; samples between its first row and the row before it belong to two tasks,
and each adds the half that falls on its own rows. Every row then receives its samples in an order that depends neither
on the threads nor on the number of tasks; and as the samples of a row come together, its values are fetched once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gridreg.ops.cpu.grid_coordinates import BATCH, PLACES, find, node
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
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import load, one
from gridreg.ops.cpu.jit.workspace import room

__all__ = ["ALONE", "ENTRY", "TASKS", "Listing", "felt", "list_by_row", "span"]

# Tasks for each axis or plane: more than threads, so that an unlucky thread does not hold the others up.
TASKS = 16
# Fewer samples than this are not worth a second thread.
ALONE = 1024
# Elements of an entry of a listing: one for each axis and one more.
ENTRY = 4


class Listing(NamedTuple):
    """The samples sorted along each of the first axes.

    Args:
        starts: ``(axes, rows + 1)`` int64; row r of axis k has the entries ``starts[k, r] : starts[k, r + 1]``.
        nodes: ``(axes, N, 4)`` int32; the node below along x, y and z, and the number of the sample.
        shares: ``(axes, N, 4)`` float32; the share of the node above along x, y and z, and the upstream gradient.
    """

    starts: Tensor
    nodes: Tensor
    shares: Tensor


@inline
def _count(rows: Any, base: Any, samples: Any, starts: Any, begin: Any, edge: Any) -> Any:
    """Make entry r + 1 the place where row r begins."""
    for row in range(begin, begin + edge + 1):
        starts[row] = 0
    for n in range(base, base + samples):
        starts[begin + rows[n] + 1] += 1
    running = int64(0)
    for row in range(begin + 1, begin + edge + 1):
        count = starts[row]
        starts[row] = running
        running += count


@kernel
def _sort(table: Any) -> None:
    """u, upstream, whether it is one number for a sample, shape, starts, nodes, shares, rows; a task is an axis."""
    u, upstream = vector(table, 0, float32), vector(table, 1, float32)
    summed = integer(table, 2) != 0
    edges = vector(table, 3, int64)
    starts, rows = vector(table, 4, int64), vector(table, 7, int32)
    to_nodes, to_shares = vector(table, 5, int32), vector(table, 6, float32)
    samples, stride = size(table, 0, 0), size(table, 4, 1)
    shape = edges[0], edges[1], edges[2]
    nodes, shares = scratch(PLACES, int32), scratch(PLACES, float32)
    places = nodes, shares
    while True:
        axis = next_task(table)
        if axis < 0:
            break
        edge, begin, base = edges[axis], axis * stride, axis * samples
        for n in range(samples):
            rows[base + n] = node(load(u, 3 * n + axis, one()), edge)[0]
        _count(rows, base, samples, starts, begin, edge)
        for first in range(0, samples, BATCH):
            count = min(int64(BATCH), samples - first)
            find(places, u, first, count, shape)
            for q in range(count):
                row = begin + rows[base + first + q] + 1
                to = ENTRY * (base + starts[row])
                # Where the row begins moves to where it ends while its samples are listed.
                starts[row] += 1
                to_nodes[to] = nodes[q]
                to_nodes[to + 1] = nodes[BATCH + q]
                to_nodes[to + 2] = nodes[2 * BATCH + q]
                to_nodes[to + 3] = first + q
                to_shares[to] = shares[q]
                to_shares[to + 1] = shares[BATCH + q]
                to_shares[to + 2] = shares[2 * BATCH + q]
                to_shares[to + 3] = upstream[first + q] if summed else float32(1)


def felt(u: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
    """Samples whose gradient is not 0, if there is one number for each: what most rays see is hardly anything.

    Args:
        u: ``(N, 3)``.
        upstream: gradients, ``(N,)`` or ``(N, C)``.
    """
    if upstream.dim() > 1:
        return u, upstream
    kept = upstream.nonzero().squeeze(1)
    return (u, upstream) if len(kept) == len(u) else (u.index_select(0, kept), upstream.index_select(0, kept))


def list_by_row(u: Tensor, upstream: Tensor, shape: tuple[int, int, int], sorts: int) -> Listing:
    """Sort samples by row, once along each of the first axes; the result is overwritten by the thread's next call.

    Args:
        u: ``(N, 3)`` in [0, 1].
        upstream: gradients, ``(N,)`` or ``(N, C)``.
        shape: nodes along x, y and z.
        sorts: number of axes.
    """
    samples = u.shape[0]
    listing = Listing(
        room("starts", sorts, max(shape[:sorts]) + 1, dtype=torch.int64),
        room("nodes", sorts, samples, ENTRY, dtype=torch.int32),
        room("shares", sorts, samples, ENTRY),
    )
    rows = room("rows", sorts, samples, dtype=torch.int32)
    summed = int(upstream.dim() == 1)
    launch(_sort, sorts, u, upstream, summed, torch.tensor(shape), *listing, rows, alone=samples < ALONE)
    return listing


@inline
def span(starts: Any, begin: Any, edge: Any, part: Any, where: Any) -> Any:
    """Entries of a third of the samples that task ``part`` of `TASKS` sees.

    Thirds: 0 for those just below its first row, of which the task owns the node above; 1 for those between two of its
    rows; 2 for those above its last row, of which it owns the node below. ``begin`` is the axis' first entry of
    ``starts``, ``edge`` its nodes.
    """
    first, last = _row_at(starts, begin, edge, part), _row_at(starts, begin, edge, part + 1)
    low = max(first - 1, 0) if where == 0 else (first if where == 1 else last - 1)
    high = first if where == 0 else (last - 1 if where == 1 else last)
    # The last node is below no sample.
    high = min(high, edge - 1)
    if last <= first or high <= low:
        return int64(0), int64(0)
    return starts[begin + low], starts[begin + high]


@inline
def _row_at(starts: Any, begin: Any, edge: Any, part: Any) -> Any:
    """First row of a task, so that all have about the same number of samples."""
    if part == TASKS:
        return edge
    wanted = starts[begin + edge - 1] * part // TASKS
    low, high = int64(0), edge
    while low < high:
        middle = (low + high) // 2
        if starts[begin + middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low
