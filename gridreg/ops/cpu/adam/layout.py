"""Constants of a fused Adam step, and how its kernel sees a grid."""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["PIECE", "Layout", "Moments", "Neighbours", "Terms", "layout"]

# Elements worked on at a time: all that one piece reads and writes stays in the first-level cache.
PIECE = 1024


class Layout(NamedTuple):
    """A contiguous tensor: spatial axes slabs, rows and nodes (1 if absent) between outer and inner ones."""

    outer: int
    slabs: int
    rows: int
    nodes: int
    inner: int


class Moments(NamedTuple):
    """Constants of one Adam step (Kingma and Ba 2015, algorithm 1).

    ``rest1`` and ``rest2`` are ``1 - beta1`` and ``1 - beta2``; ``rate`` is the learning rate over ``1 -
    beta1^t``, ``root`` is ``1 / sqrt(1 - beta2^t)``; parameters are multiplied by ``keep`` first (decoupled
    weight decay).
    """

    rest1: float
    beta2: float
    rest2: float
    rate: float
    root: float
    eps: float
    keep: float


class Neighbours(NamedTuple):
    """Distances, in elements, to neighbours within a slab; 0 where there is none."""

    left: int
    right: int
    up: int
    down: int


class Terms(NamedTuple):
    """Factors of what is added to the gradient.

    ``slabs``, ``rows`` and ``nodes`` multiply ``2 p_i - p_{i-1} - p_{i+1}`` along an axis, ``sign`` the sign
    of p, ``value`` p.
    """

    slabs: float = 0.0
    rows: float = 0.0
    nodes: float = 0.0
    sign: float = 0.0
    value: float = 0.0


def layout(shape: tuple[int, ...], spatial: tuple[int, ...]) -> Layout | None:
    """Layout of a tensor with neighbour differences along ``spatial``; None if the kernel cannot take it.

    Up to three spatial axes that follow each other, in any number of other axes before and after them.

    Example:
        >>> layout((300, 200, 48), (0, 1))
        Layout(outer=1, slabs=300, rows=1, nodes=200, inner=48)
    """
    if not spatial:
        return Layout(1, 1, 1, 1, math.prod(shape))
    axes = sorted(axis % len(shape) for axis in spatial)
    first, last = axes[0], axes[-1]
    if axes != list(range(first, last + 1)) or len(axes) > 3:
        return None
    edges = [shape[axis] for axis in axes]
    slabs, rows, nodes = {1: [*edges, 1, 1], 2: [edges[0], 1, edges[-1]], 3: edges}[len(axes)]
    return Layout(math.prod(shape[:first]), slabs, rows, nodes, math.prod(shape[last + 1 :]))
