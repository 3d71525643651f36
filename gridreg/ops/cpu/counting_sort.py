"""Counting sort of samples by grid row, so that each task owns its rows and gradients need no atomics.

Adding gradients to a grid in parallel needs owners (elsewhere a ``scatter_add`` with atomics). Channels as owners split
cache lines between threads; here a task owns whole rows. A counting sort lists the samples by the row below them, in
sample order within a row. A task takes a range of rows with its part of the samples; samples between its first row and
the row before it belong to two tasks, and each adds the half that falls on its own rows. Every row then receives its
samples in an order that depends neither on the threads nor on the number of tasks; and as the samples of a row come
together, its values are fetched once.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from gridreg.ops.cpu.grid_coordinates import BATCH, COORDINATES, locate, node
from gridreg.ops.cpu.jit.compiler import inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import load, scalar_zero
from gridreg.ops.cpu.jit.table import Vector, float32, int32, int64, scratch
from gridreg.ops.cpu.jit.workspace import workspace

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
        fractions: ``(axes, N, 4)`` float32; the fraction of the way to the node above along x, y and z, and the
            upstream gradient.
    """

    starts: Tensor
    nodes: Tensor
    fractions: Tensor


@inline
def _count(rows: Any, base: int, samples: int, starts: Any, begin: int, edge: int) -> None:
    """Set entry r + 1 to where row r begins."""
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
def _sort(
    axis: int, u: Vector[float32], upstream: Vector[float32], summed: int64, edges: Vector[int64], stride: int64,
    starts: Vector[int64], nodes: Vector[int32], fractions: Vector[float32], rows: Vector[int32],
) -> None:  # fmt: skip
    """Sort along one axis; ``summed``: upstream is one number a sample; ``stride``: of an axis in ``starts``."""
    samples, shape = u.shape[0] // 3, (edges[0], edges[1], edges[2])
    found, between = scratch(COORDINATES, int32), scratch(COORDINATES, float32)
    edge, begin, base = edges[axis], axis * stride, axis * samples
    for n in range(samples):
        rows[base + n] = node(load(u, 3 * n + axis, scalar_zero()), edge)[0]
    _count(rows, base, samples, starts, begin, edge)
    for first in range(0, samples, BATCH):
        count = min(int64(BATCH), samples - first)
        locate(found, between, u, first, count, shape)
        for q in range(count):
            row = begin + rows[base + first + q] + 1
            to = ENTRY * (base + starts[row])
            # Where the row begins moves to where it ends while its samples are listed.
            starts[row] += 1
            nodes[to] = found[q]
            nodes[to + 1] = found[BATCH + q]
            nodes[to + 2] = found[2 * BATCH + q]
            nodes[to + 3] = first + q
            fractions[to] = between[q]
            fractions[to + 1] = between[BATCH + q]
            fractions[to + 2] = between[2 * BATCH + q]
            fractions[to + 3] = upstream[first + q] if summed != 0 else float32(1)


def nonzero_gradients(u: Tensor, upstream: Tensor) -> tuple[Tensor, Tensor]:
    """Samples whose gradient is not 0, if there is one number for each: most of what rays see is next to nothing.

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
    samples, stride = u.shape[0], max(shape[:sorts]) + 1
    listing = Listing(
        workspace("starts", sorts, stride, dtype=torch.int64),
        workspace("nodes", sorts, samples, ENTRY, dtype=torch.int32),
        workspace("fractions", sorts, samples, ENTRY),
    )
    rows = workspace("rows", sorts, samples, dtype=torch.int32)
    summed, alone = int(upstream.dim() == 1), samples < ALONE
    launch(_sort, sorts, u, upstream, summed, torch.tensor(shape), stride, *listing, rows, alone=alone)
    return listing


@inline
def span(starts: Any, begin: int, edge: int, part: int, third: int) -> tuple[int, int]:
    """Entries of a third of the samples that task ``part`` of `TASKS` sees.

    Thirds: 0 for those just below its first row, of which the task owns the node above; 1 for those between two of its
    rows; 2 for those above its last row, of which it owns the node below. ``begin`` is the axis' first entry of
    ``starts``, ``edge`` its nodes.
    """
    first, last = _row_at(starts, begin, edge, part), _row_at(starts, begin, edge, part + 1)
    low = max(first - 1, 0) if third == 0 else (first if third == 1 else last - 1)
    high = first if third == 0 else (last - 1 if third == 1 else last)
    # The last node is below no sample.
    high = min(high, edge - 1)
    if last <= first or high <= low:
        return int64(0), int64(0)
    return starts[begin + low], starts[begin + high]


@inline
def _row_at(starts: Any, begin: int, edge: int, part: int) -> Any:
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
