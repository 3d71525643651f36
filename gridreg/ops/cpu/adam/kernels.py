"""Compiled Adam update with the gradients of local grid terms: memory is read and written once."""

from __future__ import annotations

from typing import Any, NamedTuple

from gridreg.ops.cpu.adam.layout import FLAT, PIECE
from gridreg.ops.cpu.jit.compiler import inline, kernel
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, total, vector_zero
from gridreg.ops.cpu.jit.simd_math import divide, flush, magnitude, sign, square_root
from gridreg.ops.cpu.jit.table import Matrix, Table, Vector, float32, float64, int64, vector
from gridreg.ops.fused_adam import Moments


class Factors(NamedTuple):
    """Factors of what is added to the gradient.

    ``slabs`` and ``nodes`` multiply ``2 p_i - p_{i-1} - p_{i+1}`` along an axis, ``sign`` the sign of p, ``value`` p.
    """

    slabs: float
    nodes: float
    sign: float
    value: float


@inline
def _difference_step(
    p: Any,
    g: Any,
    low: Any,
    below: int,
    high: Any,
    above: int,
    i: int,
    left: int,
    right: int,
    k: Any,
    zero: Any,
) -> tuple[Any, Any]:
    """Add the differences to neighbours by slab and by node to the gradient; returns the squares of those ahead.

    A missing neighbour is the element itself, as its distance is 0: its difference is 0.
    """
    c = load(p, i, zero)
    by_slab, by_node = load(high, above, zero) - c, load(p, i + right, zero) - c
    gradient = load(g, i, zero) + k.slabs * (c - load(low, below, zero) - by_slab)
    store(g, i, gradient + k.nodes * (c - load(p, i - left, zero) - by_node))
    return by_slab * by_slab, by_node * by_node


@inline
def _differences(
    p: Any, g: Any, low: Any, below: int, high: Any, above: int, at: int, count: int, left: int, right: int, k: Any,
    sums: Any,
) -> None:  # fmt: skip
    """`_difference_step` for ``count`` elements from ``at`` on whose neighbours are equally far."""
    for first in range(0, count, PIECE):
        last = min(first + PIECE, count)
        split = last - (last - first) % LANES
        a0, a1 = vector_zero(), vector_zero()
        for i in range(first, split, LANES):
            b0, b1 = _difference_step(
                p, g, low, below + i, high, above + i, at + i, left, right, k, vector_zero()
            )
            a0, a1 = a0 + b0, a1 + b1
        c0, c1 = total(a0), total(a1)
        for i in range(split, last):
            d0, d1 = _difference_step(
                p, g, low, below + i, high, above + i, at + i, left, right, k, scalar_zero()
            )
            c0, c1 = c0 + d0, c1 + d1
        sums[0] += c0
        sums[1] += c1


@inline
def _slab_differences(
    p: Any,
    g: Any,
    low: Any,
    below: int,
    high: Any,
    above: int,
    at: int,
    nodes: int,
    inner: int,
    k: Any,
    sums: Any,
) -> None:
    """Add the differences to all neighbours to the gradient of the slab at ``at``; the slabs before and behind it begin
    at ``below`` of low and at ``above`` of high."""
    length = nodes * inner
    # The first node has no left neighbour, the last one no right one.
    for part in range(3):
        start = 0 if part == 0 else inner if part == 1 else length - inner
        stop = inner if part == 0 else length - inner if part == 1 else length
        if part == 2 and nodes == 1:
            continue
        left, right = 0 if part == 0 else inner, 0 if part == 2 or nodes == 1 else inner
        _differences(
            p, g, low, below + start, high, above + start, at + start, stop - start, left, right, k, sums
        )


@inline
def _step(p: Any, g: Any, m: Any, v: Any, i: int, zero: Any, s: Any, k: Any) -> tuple[Any, Any]:
    """Update moments and parameter at ``i`` and clear the gradient; returns ``|p|`` and ``p^2`` of before."""
    c, slope = load(p, i, zero), load(g, i, zero)
    store(g, i, zero)
    gradient = slope + k.sign * sign(c) + k.value * c
    moment = load(m, i, c)
    moment = flush(moment + s.rest1 * (gradient - moment))
    square = flush(s.beta2 * load(v, i, c) + s.rest2 * (gradient * gradient))
    store(m, i, moment)
    store(v, i, square)
    store(p, i, s.keep * c - s.rate * divide(moment, square_root(square) * s.root + s.eps))
    return magnitude(c), c * c


@inline
def _steps(p: Any, g: Any, m: Any, v: Any, begin: int, end: int, s: Any, k: Any, sums: Any) -> None:
    """`_step` for some elements, added to the sums of ``|p|`` and ``p^2``."""
    for first in range(begin, end, PIECE):
        last = min(first + PIECE, end)
        split = last - (last - first) % LANES
        sizes, squares = vector_zero(), vector_zero()
        for i in range(first, split, LANES):
            size, square = _step(p, g, m, v, i, vector_zero(), s, k)
            sizes, squares = sizes + size, squares + square
        size_sum, square_sum = total(sizes), total(squares)
        for i in range(split, last):
            size, square = _step(p, g, m, v, i, scalar_zero(), s, k)
            size_sum, square_sum = size_sum + size, square_sum + square
        sums[2] += size_sum
        sums[3] += square_sum


@inline
def _idle(g: Any, m: Any, v: Any, first: int, last: int) -> Any:
    """Whether a step without local terms would leave all as it is."""
    split = last - (last - first) % LANES
    sizes = vector_zero()
    for i in range(first, split, LANES):
        sizes = (
            sizes
            + magnitude(load(g, i, vector_zero()))
            + magnitude(load(m, i, vector_zero()))
            + load(v, i, vector_zero())
        )
    size = total(sizes)
    for i in range(split, last):
        size += abs(g[i]) + abs(m[i]) + v[i]
    return size == float32(0)


@inline
def _constants(x: Any) -> tuple[Any, Any]:
    return Moments(x[0], x[1], x[2], x[3], x[4], x[5], x[6]), Factors(x[7], x[8], x[9], x[10])


@inline
def _tensors(table: Table, start: int) -> tuple[Any, Any, Any, Any]:
    """p, g, m and v from ``start`` on."""
    p, g = vector(table, start, float32), vector(table, start + 1, float32)
    return p, g, vector(table, start + 2, float32), vector(table, start + 3, float32)


@kernel
def flat_step(
    task: int, numbers: Matrix[float32], parts: Matrix[int64], sums: Matrix[float64], table: Table
) -> None:
    """Update elements without terms that look at neighbours.

    Constants ``(jobs, 11)``, job and first element of each task ``(tasks, 2)``, sums ``(tasks, 4)``; then p, g, m and v
    of each job.
    """
    job, begin = parts[task, 0], parts[task, 1]
    p, g, m, v = _tensors(table, 3 + 4 * job)
    s, k = _constants(numbers[job])
    skips = k.sign == float32(0) and k.value == float32(0) and s.keep == float32(1)
    end = min(begin + FLAT, p.shape[0])
    for first in range(begin, end, PIECE):
        last = min(first + PIECE, end)
        if not (skips and m[first] == float32(0) and _idle(g, m, v, first, last)):
            _steps(p, g, m, v, first, last, s, k, sums[task])


@kernel
def keep_edges(
    task: int, parts: Matrix[int64], before: Vector[float32], after: Vector[float32], table: Table
) -> None:
    """Copy what a block reads of the blocks beside it, which may be updated before.

    Tasks ``(E, 4)``: job, first element of a block, elements of a slab, first element in what is
    written; the slabs before these blocks, the first of these; then p of each job.
    """
    p = vector(table, 3 + parts[task, 0], float32)
    at, slab, to = parts[task, 1], parts[task, 2], parts[task, 3]
    split = slab - slab % LANES
    for i in range(0, split, LANES):
        store(before, to + i, load(p, at - slab + i, vector_zero()))
        store(after, to + i, load(p, at + i, vector_zero()))
    for i in range(split, slab):
        before[to + i] = p[at - slab + i]
        after[to + i] = p[at + i]


@kernel
def grid_step(
    task: int, numbers: Matrix[float32], shapes: Matrix[int64], parts: Matrix[int64], sums: Matrix[float64],
    before: Vector[float32], after: Vector[float32], table: Table,
) -> None:  # fmt: skip
    """Update a block of slabs with terms that look at neighbours.

    Constants ``(jobs, 11)``, shapes ``(jobs, 3)``: slabs, nodes, inner; tasks ``(tasks, 5)``: job, first element of its
    slabs, first and last slab, first element of the edges behind it; sums ``(tasks, 4)``, what `keep_edges` wrote; then
    p, g, m and v of each job. A slab is updated as soon as the differences of the next one are known, as
    these still need its old values; what lies in other blocks was copied beforehand.
    """
    job, begin, first, last, edge = (
        parts[task, 0], parts[task, 1], parts[task, 2], parts[task, 3], parts[task, 4],
    )  # fmt: skip
    p, g, m, v = _tensors(table, 6 + 4 * job)
    s, k = _constants(numbers[job])
    slabs, nodes, inner = shapes[job, 0], shapes[job, 1], shapes[job, 2]
    slab = nodes * inner
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
        _slab_differences(p, g, low, below, high, above, at, nodes, inner, k, sums[task])
        if a > first:
            _steps(p, g, m, v, at - slab, at, s, k, sums[task])
    at = begin + (last - 1) * slab
    _steps(p, g, m, v, at, at + slab, s, k, sums[task])
