"""Compiled Adam update with the gradients of local grid terms: memory is read and written once."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from backbones.kernels.adam_differences import add_differences
from backbones.kernels.adam_layout import PIECE, Layout, Moments, Terms
from backbones.kernels.compiler import float32, inline, int64, integer, kernel, matrix, next_task, vector
from backbones.kernels.simd import LANES, load, one, store, total, wide
from backbones.kernels.simd_math import divide, flush, magnitude, sign, square_root
from backbones.kernels.threading import launch

__all__ = ["Job", "update", "update_flat"]

# Blocks of slabs that may be updated at the same time; fixed, so that sums do not depend on threads.
_BLOCKS = 16
# Elements of a task where no term looks at neighbours.
_FLAT = 1 << 15
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
        place = 3 + 4 * job
        p, g, m, v = (
            vector(table, place, float32),
            vector(table, place + 1, float32),
            vector(table, place + 2, float32),
            vector(table, place + 3, float32),
        )
        s, k = _constants(numbers[job]), _factors(numbers[job])
        skips = k.sign == _ZERO and k.value == _ZERO and s.keep == _ONE
        end = min(begin + _FLAT, p.shape[0])
        for first in range(begin, end, PIECE):
            last = min(first + PIECE, end)
            if not (skips and m[first] == _ZERO and _idle(g, m, v, first, last)):
                _flat_piece(p, g, m, v, first, last, s, k, sums[task])


@kernel
def _grid(table: Any) -> None:
    """As `_flat`, then the old slabs before and after each block, slabs, rows, nodes, inner, slabs of a
    block.

    A task is a block of slabs. A slab is updated as soon as the differences of the next one are known, as these still
    need its old values; what lies in other blocks was copied beforehand.
    """
    p, g, m, v = (
        vector(table, 0, float32),
        vector(table, 1, float32),
        vector(table, 2, float32),
        vector(table, 3, float32),
    )
    numbers, sums = vector(table, 4, float32), matrix(table, 5, np.float64)
    before, after = vector(table, 6, float32), vector(table, 7, float32)
    slabs, rows, nodes, inner, block = (
        integer(table, 8),
        integer(table, 9),
        integer(table, 10),
        integer(table, 11),
        integer(table, 12),
    )
    s, k = _constants(numbers), _factors(numbers)
    slab = rows * nodes * inner
    blocks = (slabs + block - 1) // block
    while True:
        task = next_task(table)
        if task < 0:
            break
        outer, number = task // blocks, task % blocks
        first, last = number * block, min((number + 1) * block, slabs)
        # Of inner boundaries only, so one slab less than there are blocks.
        edge = (outer * (blocks - 1) + number) * slab
        for a in range(first, last):
            at = (outer * slabs + a) * slab
            low, below, high, above = p, at, p, at
            if a > first:
                below = at - slab
            elif number > 0:
                low, below = before, edge - slab
            if a + 1 < last:
                above = at + slab
            elif a + 1 < slabs:
                high, above = after, edge
            add_differences(p, g, low, below, high, above, at, rows, nodes, inner, k, sums[task])
            if a > first:
                _flat_piece(p, g, m, v, at - slab, at, s, k, sums[task])
        at = (outer * slabs + last - 1) * slab
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


@functools.lru_cache(maxsize=16)
def _parts(sizes: tuple[int, ...]) -> tuple[Tensor, tuple[int, ...]]:
    """``(P, 2)`` int64, number and first element of the parts of tensors, and where those of each begin and end."""
    parts, ends = [], [0]
    for number, size in enumerate(sizes):
        parts += [(number, first) for first in range(0, size, _FLAT)]
        ends.append(len(parts))
    return torch.tensor(parts).view(-1, 2), tuple(ends)


def update_flat(jobs: Sequence[Job]) -> list[Tensor]:
    """`update` of several parameters at once; none of them has a term that looks at neighbours."""
    parts, ends = _parts(tuple(job.p.numel() for job in jobs))
    tensors = [tensor for job in jobs for tensor in job.tensors]
    numbers = torch.tensor([(*job.moments, *job.terms) for job in jobs], dtype=torch.float32)
    sums = torch.zeros(len(parts), 5, dtype=torch.float64)
    launch(_flat, len(parts), numbers, parts, sums, *tensors)
    return [sums[first:last] for first, last in pairwise(ends)]


def update(job: Job, shape: Layout) -> Tensor:
    """One Adam step on ``p``, in place; adds the local gradients to ``g``, and then clears it.

    Args:
        job: tensors and constants; a term looks at neighbours.
        shape: of the tensors, from `layout`.

    Returns:
        ``(parts, 5)`` float64: of the parameters before the step, the sums of squared forward differences along slabs,
        rows and nodes, of absolute values and of squares, by parts; 0 for those whose factor in ``terms`` is 0.
    """
    constants = torch.tensor((*job.moments, *job.terms), dtype=torch.float32)
    tensors = job.tensors
    block = -(-shape.slabs // _BLOCKS)
    blocks = -(-shape.slabs // block)
    slabs = tensors[0].view(shape.outer, shape.slabs, -1)
    # Copies, also where a slice is contiguous as it is.
    before, after = (
        x.clone(memory_format=torch.contiguous_format).view(-1)
        for x in (slabs[:, block - 1 : (blocks - 1) * block : block], slabs[:, block::block])
    )
    sums = torch.zeros(shape.outer * blocks, 5, dtype=torch.float64)
    launch(_grid, len(sums), *tensors, constants, sums, before, after, *shape[1:], block)
    return sums
