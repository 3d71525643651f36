"""How a fused Adam step of several parameters is shared out among tasks."""

from __future__ import annotations

import functools
from typing import NamedTuple

import torch
from torch import Tensor

from gridreg.ops.cpu.adam.layout import Layout

__all__ = ["FLAT", "GridTasks", "flat_tasks", "grid_tasks"]

FLAT = 1 << 15
"""Elements of a task where no term looks at neighbours."""


class GridTasks(NamedTuple):
    """Tables that the kernels of `gridreg.ops.cpu.adam.update` read for parameters with neighbours, int64.

    Args:
        parts: of each task, the part of a parameter that it updates.
        starts: where the tasks of each parameter begin.
        shapes: of each parameter: slabs, rows, nodes, inner.
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
    """Of parameters with neighbours; each is cut into so many blocks of slabs."""
    parts: list[tuple[int, ...]] = []
    edges: list[tuple[int, ...]] = []
    starts, held = [], 0
    for job, (outer, slabs, rows, nodes, inner) in enumerate(shapes):
        starts.append(len(parts))
        slab, block = rows * nodes * inner, -(-slabs // blocks)
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
        torch.tensor([shape[1:] for shape in shapes]).view(-1, 4),
        torch.tensor(edges, dtype=torch.int64).view(-1, 4),
        held,
    )
