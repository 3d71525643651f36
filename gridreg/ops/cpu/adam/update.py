"""Compiled Adam update with the gradients of local grid terms: memory is read and written once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gridreg.ops.cpu.adam.differences import add_differences
from gridreg.ops.cpu.adam.layout import PIECE, Layout, Moments, Terms
from gridreg.ops.cpu.adam.tasks import FLAT, flat_tasks, grid_tasks
from gridreg.ops.cpu.jit.compiler import float32, inline, int64, kernel, matrix, next_task, vector
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, total, wide
from gridreg.ops.cpu.jit.simd_math import divide, flush, magnitude, sign, square_root
from gridreg.ops.cpu.jit.workspace import workspace

__all__ = ["Job", "update", "update_flat"]

# Blocks of slabs that may be updated at the same time; fixed, so that sums do not depend on threads.
_BLOCKS = 16
_ZERO, _ONE = np.float32(0), np.float32(1)


@inline
def _moments(p: Any, m: Any, v: Any, i: int, c: Any, gradient: Any, s: Any) -> None:
    """Update the moments at ``i`` by the gradient and write the parameter that was ``c``."""
    moment = load(m, i, c)
    moment = flush(moment + s.rest1 * (gradient - moment))
    square = flush(s.beta2 * load(v, i, c) + s.rest2 * (gradient * gradient))
    store(m, i, moment)
    store(v, i, square)
    store(p, i, s.keep * c - s.rate * divide(moment, square_root(square) * s.root + s.eps))


@inline
def _flat_step(p: Any, g: Any, m: Any, v: Any, i: int, like: Any, s: Any, k: Any) -> tuple[Any, Any]:
    """One step of `_flat`; returns what it adds to the sums of ``|p|`` and ``p^2``."""
    c, slope = load(p, i, like), load(g, i, like)
    store(g, i, like)
    _moments(p, m, v, i, c, slope + k.sign * sign(c) + k.value * c, s)
    return magnitude(c), c * c


@inline
def _idle(g: Any, m: Any, v: Any, first: int, last: int) -> Any:
    """Whether a step without local terms would leave all as it is."""
    split = last - (last - first) % LANES
    sizes = wide()
    for i in range(first, split, LANES):
        sizes = sizes + magnitude(load(g, i, wide())) + magnitude(load(m, i, wide())) + load(v, i, wide())
    size = total(sizes)
    for i in range(split, last):
        size += abs(g[i]) + abs(m[i]) + v[i]
    return size == _ZERO


@inline
def _constants(x: Any) -> Moments:
    return Moments(x[0], x[1], x[2], x[3], x[4], x[5], x[6])


@inline
def _factors(x: Any) -> Terms:
    return Terms(x[7], x[8], x[9], x[10], x[11])


@inline
def _tensors(table: Any, place: int) -> tuple[Any, Any, Any, Any]:
    """p, g, m, v."""
    return (
        vector(table, place, float32),
        vector(table, place + 1, float32),
        vector(table, place + 2, float32),
        vector(table, place + 3, float32),
    )


@inline
def _flat_piece(p: Any, g: Any, m: Any, v: Any, begin: int, end: int, s: Any, k: Any, sums: Any) -> None:
    """`_flat_step` for some elements, added to the sums of ``|p|`` and ``p^2``."""
    for first in range(begin, end, PIECE):
        last = min(first + PIECE, end)
        split = last - (last - first) % LANES
        sizes, squares = wide(), wide()
        for i in range(first, split, LANES):
            size, square = _flat_step(p, g, m, v, i, wide(), s, k)
            sizes, squares = sizes + size, squares + square
        size_sum, square_sum = total(sizes), total(squares)
        for i in range(split, last):
            size, square = _flat_step(p, g, m, v, i, one(), s, k)
            size_sum, square_sum = size_sum + size, square_sum + square
        sums[3] += size_sum
        sums[4] += square_sum


@kernel
def _flat(table: Any) -> None:
    """Constants ``(jobs, 12)``, job and first element of each task ``(tasks, 2)``, sums ``(tasks, 5)``; then of each
    job p, g, m, v."""
    numbers, parts, sums = matrix(table, 0, float32), matrix(table, 1, int64), matrix(table, 2, np.float64)
    while True:
        task = next_task(table)
        if task < 0:
            break
        job, begin = parts[task, 0], parts[task, 1]
        p, g, m, v = _tensors(table, 3 + 4 * job)
        s, k = _constants(numbers[job]), _factors(numbers[job])
        skips = k.sign == _ZERO and k.value == _ZERO and s.keep == _ONE
        end = min(begin + FLAT, p.shape[0])
        for first in range(begin, end, PIECE):
            last = min(first + PIECE, end)
            if not (skips and m[first] == _ZERO and _idle(g, m, v, first, last)):
                _flat_piece(p, g, m, v, first, last, s, k, sums[task])


@kernel
def _edges(table: Any) -> None:
    """Tasks ``(E, 4)``: job, first element of a block, elements of a slab, place in what is written; the slabs before
    these blocks, the first of these; then of each job p.

    Copies what a block reads of the blocks beside it, which may be updated before.
    """
    parts, before, after = matrix(table, 0, int64), vector(table, 1, float32), vector(table, 2, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        p = vector(table, 3 + parts[task, 0], float32)
        at, slab, to = parts[task, 1], parts[task, 2], parts[task, 3]
        split = slab - slab % LANES
        for i in range(0, split, LANES):
            store(before, to + i, load(p, at - slab + i, wide()))
            store(after, to + i, load(p, at + i, wide()))
        for i in range(split, slab):
            before[to + i] = p[at - slab + i]
            after[to + i] = p[at + i]


@kernel
def _grid(table: Any) -> None:
    """Constants ``(jobs, 12)``, shapes ``(jobs, 4)``: slabs, rows, nodes, inner; tasks ``(tasks, 5)``: job, first
    element of its slabs, first and last slab, place of the edges behind it; sums ``(tasks, 5)``, what `_edges` wrote;
    then of each job p, g, m, v.

    A task is a block of slabs. A slab is updated as soon as the differences of the next one are known, as these still
    need its old values; what lies in other blocks was copied beforehand.
    """
    numbers, shapes, parts = matrix(table, 0, float32), matrix(table, 1, int64), matrix(table, 2, int64)
    sums, before, after = matrix(table, 3, np.float64), vector(table, 4, float32), vector(table, 5, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        job, begin, first, last, edge = (
            parts[task, 0],
            parts[task, 1],
            parts[task, 2],
            parts[task, 3],
            parts[task, 4],
        )
        p, g, m, v = _tensors(table, 6 + 4 * job)
        s, k = _constants(numbers[job]), _factors(numbers[job])
        slabs, rows, nodes, inner = shapes[job, 0], shapes[job, 1], shapes[job, 2], shapes[job, 3]
        slab = rows * nodes * inner
        for a in range(first, last):
            at = begin + a * slab
            low, below, high, above = p, at, p, at
            if a > first:
                below = at - slab
            elif a > 0:
                low, below = before, edge - slab
            if a + 1 < last:
                above = at + slab
            elif a + 1 < slabs:
                high, above = after, edge
            add_differences(p, g, low, below, high, above, at, rows, nodes, inner, k, sums[task])
            if a > first:
                _flat_piece(p, g, m, v, at - slab, at, s, k, sums[task])
        at = begin + (last - 1) * slab
        _flat_piece(p, g, m, v, at, at + slab, s, k, sums[task])


class Job(NamedTuple):
    """One parameter's step.

    Args:
        p, g, m, v: parameter, gradient and both moments; contiguous float32 CPU tensors of one size.
        moments, terms: constants of the step.
    """

    p: Tensor
    g: Tensor
    m: Tensor
    v: Tensor
    moments: Moments
    terms: Terms

    @property
    def flat(self) -> bool:
        """Whether no term looks at neighbours."""
        return not (self.terms.slabs or self.terms.rows or self.terms.nodes)

    @property
    def tensors(self) -> list[Tensor]:
        """As vectors."""
        return [self.p.detach().view(-1), self.g.view(-1), self.m.view(-1), self.v.view(-1)]


def _numbers(jobs: Sequence[Job]) -> Tensor:
    return torch.tensor([(*job.moments, *job.terms) for job in jobs], dtype=torch.float32)


def _by_job(sums: Tensor, starts: tuple[int, ...]) -> list[list[float]]:
    """The sums of each job's tasks."""
    found: list[list[float]] = np.add.reduceat(sums.numpy(), starts, axis=0).tolist()
    return found


def update_flat(jobs: Sequence[Job]) -> list[list[float]]:
    """`update` of parameters none of which has a term that looks at neighbours."""
    if not jobs:
        return []
    parts, starts = flat_tasks(tuple(job.p.numel() for job in jobs))
    tensors = [tensor for job in jobs for tensor in job.tensors]
    sums = torch.zeros(len(parts), 5, dtype=torch.float64)
    launch(_flat, len(sums), _numbers(jobs), parts, sums, *tensors)
    return _by_job(sums, starts)


def update(jobs: Sequence[Job], shapes: Sequence[Layout]) -> list[list[float]]:
    """One Adam step on each ``p``, in place; adds the local gradients to ``g``, and then clears it.

    Args:
        jobs: tensors and constants, one or more; of each a term looks at neighbours.
        shapes: of their tensors, from `layout`.

    Returns:
        Of each the sums, over the parameters before the step, of squared forward differences along slabs, rows and
        nodes, of absolute values and of squares; 0 for those whose factor in ``terms`` is 0.
    """
    if not jobs:
        return []
    tasks = grid_tasks(tuple(shapes), _BLOCKS)
    tensors = [job.tensors for job in jobs]
    before, after = workspace("adam edges", 2, tasks.held)
    launch(_edges, len(tasks.edges), tasks.edges, before, after, *(p for p, _, _, _ in tensors))
    sums = torch.zeros(len(tasks.parts), 5, dtype=torch.float64)
    flat = [tensor for four in tensors for tensor in four]
    launch(_grid, len(sums), _numbers(jobs), tasks.shapes, tasks.parts, sums, before, after, *flat)
    return _by_job(sums, tasks.starts)
