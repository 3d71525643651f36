"""Who may write where: samples sorted by the row of the plane that they touch.

Adding gradients to a plane in parallel needs owners. Channels as owners split cache lines between threads; so here a
task owns whole rows. For each plane a counting sort lists the samples by the row below them, in sample order within a
row. A task takes a range of rows with its share of the samples; samples between its first row and the row before it
belong to two tasks, and each adds the half that falls on its own rows. Every row then receives its samples in an
order that depends neither on the threads nor on the number of tasks.
"""

from __future__ import annotations

import torch
from torch import Tensor

from backbones.kernels.compiler import float32, inline, int32, int64, kernel, next_task, size, vector
from backbones.kernels.lookup import node
from backbones.kernels.threading import launch

__all__ = ["TASKS", "owned_rows", "sort_by_row"]

# Tasks for each plane: more than threads, so that an unlucky thread does not hold the others up.
TASKS = 16


@kernel
def _sort(table):  # type: ignore[no-untyped-def]
    """u, active (N,), starts (3, rows + 1) to be filled, order (3, N) to be filled, edges (3,), row of each (N,)."""
    u = vector(table, 0, float32)
    active = vector(table, 1, float32)
    starts_of_all, order_of_all = vector(table, 2, int64), vector(table, 3, int32)
    edges = vector(table, 4, int64)
    rows_of_all = vector(table, 5, int32)
    samples, stride = size(table, 0, 0), size(table, 2, 1)
    while True:
        plane = next_task(table)
        if plane < 0:
            break
        axis = 1 if plane == 2 else 0
        edge = edges[plane]
        starts = starts_of_all[plane * stride : (plane + 1) * stride]
        order = order_of_all[plane * samples : (plane + 1) * samples]
        rows = rows_of_all[plane * samples : (plane + 1) * samples]
        starts[:] = 0
        for n in range(samples):
            row = node(u[3 * n + axis], edge)[0] if active[n] != float32(0) else int64(-1)
            rows[n] = row
            starts[row + 1] += 1
        # Entry 0 has counted the samples without a gradient, which are in no row.
        starts[0] = 0
        # Entry r + 1 becomes where row r begins, and moves to where it ends while the samples are listed.
        running = int64(0)
        for row in range(edge):
            count = starts[row + 1]
            starts[row + 1] = running
            running += count
        for n in range(samples):
            row = rows[n]
            if row >= 0:
                order[starts[row + 1]] = n
                starts[row + 1] += 1


def sort_by_row(u: Tensor, active: Tensor, edges: list[int]) -> tuple[Tensor, Tensor]:
    """List the samples of each plane by row.

    Args:
        u: ``(N, 3)``.
        active: ``(N,)`` float32; samples where it is 0 are left out.
        edges: rows of the three planes.

    Returns:
        ``order (3, N)`` int32 and ``starts (3, rows + 1)`` int64: row r of plane k has the samples
        ``order[k, starts[k, r] : starts[k, r + 1]]``.
    """
    samples = u.shape[0]
    starts = torch.empty(3, max(edges) + 1, dtype=torch.int64)
    order, rows = torch.empty(2, 3, samples, dtype=torch.int32)
    launch(_sort, 3, u, active, starts, order, torch.tensor(edges), rows)
    return order, starts


@inline
def owned_rows(starts, edge, part, parts):  # type: ignore[no-untyped-def]
    """First and last (exclusive) row of one of ``parts`` ranges with about equal numbers of samples."""
    first = _row_at(starts, edge, part, parts)
    return first, _row_at(starts, edge, part + 1, parts)


@inline
def _row_at(starts, edge, part, parts):  # type: ignore[no-untyped-def]
    if part == parts:
        return edge
    wanted = starts[edge - 1] * part // parts
    low, high = int64(0), edge
    while low < high:
        middle = (low + high) // 2
        if starts[middle] < wanted:
            low = middle + 1
        else:
            high = middle
    return low
