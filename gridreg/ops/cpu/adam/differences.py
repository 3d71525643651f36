"""Gradients of the squared differences between neighbours, added before a fused Adam step."""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.adam.layout import PIECE, Neighbours
from gridreg.ops.cpu.jit.compiler import inline
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, total, wide

__all__ = ["add_differences"]


@inline
def _plane_step(
    p: Any, g: Any, low: Any, high: Any, i: int, below: int, above: int, n: Any, like: Any, k: Any
) -> tuple[Any, Any, Any]:
    """Add the differences to the neighbours by slab and by node to the gradient; returns the squares of those ahead.

    A missing neighbour is the element itself, as its offset is 0: its difference is 0.
    """
    c = load(p, i, like)
    by_slab, by_node = load(high, above, like) - c, load(p, i + n.right, like) - c
    gradient = load(g, i, like) + k.slabs * (c - load(low, below, like) - by_slab)
    store(g, i, gradient + k.nodes * (c - load(p, i - n.left, like) - by_node))
    return by_slab * by_slab, like, by_node * by_node


@inline
def _solid_step(
    p: Any, g: Any, low: Any, high: Any, i: int, below: int, above: int, n: Any, like: Any, k: Any
) -> tuple[Any, Any, Any]:
    """`_plane_step`, and the neighbours by row."""
    c = load(p, i, like)
    by_row = load(p, i + n.down, like) - c
    store(g, i, load(g, i, like) + k.rows * (c - load(p, i - n.up, like) - by_row))
    by_slab, _, by_node = _plane_step(p, g, low, high, i, below, above, n, like, k)
    return by_slab, by_row * by_row, by_node


@inline
def _difference_piece(
    p: Any, g: Any, low: Any, high: Any, at: int, below: int, above: int, count: int, n: Any, k: Any, sums: Any,
    step: Any,
) -> None:  # fmt: skip
    """``count`` elements from ``at`` on that all have the same neighbours."""
    for first in range(0, count, PIECE):
        last = min(first + PIECE, count)
        split = last - (last - first) % LANES
        a0, a1, a2 = wide(), wide(), wide()
        for i in range(first, split, LANES):
            b0, b1, b2 = step(p, g, low, high, at + i, below + i, above + i, n, wide(), k)
            a0, a1, a2 = a0 + b0, a1 + b1, a2 + b2
        c0, c1, c2 = total(a0), total(a1), total(a2)
        for i in range(split, last):
            d0, d1, d2 = step(p, g, low, high, at + i, below + i, above + i, n, one(), k)
            c0, c1, c2 = c0 + d0, c1 + d1, c2 + d2
        sums[0] += c0
        sums[1] += c1
        sums[2] += c2


@inline
def add_differences(
    p: Any, g: Any, low: Any, below: int, high: Any, above: int, at: int, rows: int, nodes: int, inner: int, k: Any,
    sums: Any,
) -> None:  # fmt: skip
    """Add the differences to all neighbours to the gradient of the slab at ``at``; the slabs before and behind it begin
    at ``below`` of low and at ``above`` of high."""
    length = nodes * inner
    for r in range(rows):
        to = r * length
        up, down = length if r > 0 else 0, length if r + 1 < rows else 0
        # The first node has no left neighbour, the last one no right one.
        for part in range(3):
            start = 0 if part == 0 else inner if part == 1 else length - inner
            stop = inner if part == 0 else length - inner if part == 1 else length
            if part == 2 and nodes == 1:
                continue
            left, right = 0 if part == 0 else inner, 0 if part == 2 or nodes == 1 else inner
            n, i, count = Neighbours(left, right, up, down), to + start, stop - start
            if rows > 1:
                _difference_piece(
                    p, g, low, high, at + i, below + i, above + i, count, n, k, sums, _solid_step
                )
            else:
                _difference_piece(
                    p, g, low, high, at + i, below + i, above + i, count, n, k, sums, _plane_step
                )
