"""Layouts of grids in a fused Adam step, and its division into tasks."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import torch
from torch import Tensor

from gridreg.ops.fused_adam import neighbour_pairs

# Elements worked on at a time: all that one piece reads and writes stays in the first-level cache.
PIECE = 1024
# Elements of a task where no term looks at neighbours.
FLAT = 1 << 15


class Layout(NamedTuple):
    """A contiguous tensor: spatial axes slabs and nodes (1 if absent) between outer and inner ones."""

    outer: int
    slabs: int
    nodes: int
    inner: int


def layout(shape: tuple[int, ...], spatial: tuple[int, ...]) -> Layout | None:
    """Layout of a tensor with neighbour differences along ``spatial``; None if the kernel cannot take it.

    One spatial axis, or two that follow each other, among any number of other axes.

    Example:
        >>> layout((300, 200, 48), (0, 1))
        Layout(outer=1, slabs=300, nodes=200, inner=48)
    """
    axes = sorted(axis % len(shape) for axis in spatial)
    if not axes:
        return Layout(1, 1, 1, math.prod(shape))
    first, last = axes[0], axes[-1]
    if axes != list(range(first, last + 1)) or len(axes) > 2:
        return None
    nodes = shape[last] if last > first else 1
    return Layout(math.prod(shape[:first]), shape[first], nodes, math.prod(shape[last + 1 :]))


class Form(NamedTuple):
    """A parameter and its terms, as the kernels see them.

    Args:
        layout: of the tensors.
        apart: numbers of terms that they cannot take.
        columns: by number of the term, the columns of the kernels' sums that make the value of a term.
        counts: by column, what the sum is divided by.
    """

    layout: Layout
    apart: tuple[int, ...]
    columns: dict[int, tuple[int, ...]]
    counts: tuple[float, ...]


@functools.lru_cache(maxsize=256)
def form_of(shape: tuple[int, ...], terms: tuple[tuple[str, tuple[int, ...]], ...]) -> Form:
    """Form of a parameter, from its shape and the kinds and axes of its terms."""
    axes: tuple[int, ...] = next((axes for _, axes in terms if axes and layout(shape, axes)), ())
    found = layout(shape, axes)
    assert found is not None
    counts = [1.0] * 2 + [float(math.prod(shape))] * 2
    for column, axis in enumerate(axes):
        counts[column] = max(1, neighbour_pairs(shape, axis))
    by_kind = {"total_variation": tuple(range(len(axes))), "l1": (2,), "l2": (3,)}
    apart = tuple(i for i, (kind, own) in enumerate(terms) if kind == "total_variation" and own != axes)
    columns = {i: by_kind[kind] for i, (kind, _) in enumerate(terms) if i not in apart}
    return Form(found, apart, columns, tuple(counts))


class GridTasks(NamedTuple):
    """Tables that the kernels read for parameters with neighbours, int64.

    Args:
        parts: of each task, the part of a parameter that it updates.
        starts: where the tasks of each parameter begin.
        shapes: of each parameter: slabs, nodes, inner.
        edges: of each boundary between two tasks, the slabs to copy.
        held: elements of the slabs before all boundaries.
    """

    parts: Tensor
    starts: tuple[int, ...]
    shapes: Tensor
    edges: Tensor
    held: int


@functools.lru_cache(maxsize=16)
def flat_tasks(sizes: tuple[int, ...]) -> tuple[Tensor, tuple[int, ...]]:
    """Parts and starts, as of `GridTasks`, of parameters without neighbours, by their numbers of elements."""
    parts: list[tuple[int, int]] = []
    starts = []
    for number, size in enumerate(sizes):
        starts.append(len(parts))
        parts += [(number, first) for first in range(0, size, FLAT)]
    return torch.tensor(parts).view(-1, 2), tuple(starts)


@functools.lru_cache(maxsize=16)
def grid_tasks(shapes: tuple[Layout, ...], blocks: int) -> GridTasks:
    """Tasks of parameters with neighbours; each is cut into so many blocks of slabs."""
    parts: list[tuple[int, ...]] = []
    edges: list[tuple[int, ...]] = []
    starts, held = [], 0
    for job, (outer, slabs, nodes, inner) in enumerate(shapes):
        starts.append(len(parts))
        slab, block = nodes * inner, -(-slabs // blocks)
        for begin in range(0, outer * slabs * slab, slabs * slab):
            for first in range(0, slabs, block):
                if first > 0:
                    edges.append((job, begin + first * slab, slab, held))
                    held += slab
                # The edge behind a block is the next one.
                parts.append((job, begin, first, min(first + block, slabs), held))
    return GridTasks(
        torch.tensor(parts).view(-1, 5),
        tuple(starts),
        torch.tensor([shape[1:] for shape in shapes]).view(-1, 3),
        torch.tensor(edges, dtype=torch.int64).view(-1, 4),
        held,
    )
