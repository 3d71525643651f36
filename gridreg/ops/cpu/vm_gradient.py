"""Compiled lookups of VM grids: gradients with respect to planes and lines.

A task owns some rows of one plane and, for the line beside it, has a copy of its own; copies are added up afterwards.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gridreg.ops.cpu.counting_sort import ALONE, ENTRY, TASKS, list_by_row, nonzero_gradients, span
from gridreg.ops.cpu.grid_coordinates import axes
from gridreg.ops.cpu.interpolation import (
    Cell,
    Segment,
    bilinear,
    cell_weights,
    linear,
    lookahead,
    prefetch_cell,
    prefetch_row,
)  # fmt: skip
from gridreg.ops.cpu.jit.compiler import Kernel, inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, vector_zero
from gridreg.ops.cpu.jit.table import Cube, Matrix, Vector, float32, int32, int64, uint16
from gridreg.ops.cpu.jit.workspace import workspace
from gridreg.ops.cpu.reductions import reduce_sum


class _Owned(NamedTuple):
    """Gradients that a task may add to.

    What falls on a row of another task, which sees the sample too, goes to an array that nobody reads.

    Args:
        plane: gradient of the plane.
        lower, upper: array for the row below and the row above the samples at hand.
        line: array for the line.
        owns_lower, owns_upper: whether these rows are the task's own.
        line_first: element at which the task's copy of the line begins.
        waste_first: the task's part of the array that nobody reads.
    """

    plane: Any
    lower: Any
    upper: Any
    line: Any
    owns_lower: Any
    owns_upper: Any
    line_first: Any
    waste_first: Any


@inline
def _targets(owned: Any, cell: Any, segment: Any) -> tuple[int, int, int]:
    """Elements of lower, upper and line at which the channels of a sample begin."""
    lower = cell.first if owned.owns_lower else owned.waste_first
    upper = cell.first + cell.down if owned.owns_upper else owned.waste_first
    return lower, upper, owned.line_first + segment.first if owned.owns_lower else owned.waste_first


# Arrays come as arguments of their own: numba counts references to those in a tuple, at each sample.
@inline
def _add(
    plane: Any, line: Any, cell: Any, segment: Any, c: int, g: Any, lower: Any, upper: Any, to_line: Any,
    targets: tuple[int, int, int], dtype_like: Any,
) -> None:  # fmt: skip
    """Add the gradient of channels from ``c`` on of a sample to four nodes of the plane and two of the line.

    All is read before anything is written: a processor holds a load back behind a store that agrees with it in the low
    bits of the address, and a gradient lies where its parameter does, but for these.
    """
    across, w, fraction = cell.across, cell.weights, segment.fraction
    i, j, m = targets[0] + c, targets[1] + c, targets[2] + c
    on_plane = linear(line, segment, c, dtype_like) * g
    on_line = bilinear(plane, cell, c, dtype_like) * g
    p00 = load(lower, i, dtype_like) + on_plane * w[0]
    p01 = load(lower, i + across, dtype_like) + on_plane * w[1]
    p10 = load(upper, j, dtype_like) + on_plane * w[2]
    p11 = load(upper, j + across, dtype_like) + on_plane * w[3]
    l0 = load(to_line, m, dtype_like) + on_line * (float32(1) - fraction)
    l1 = load(to_line, m + across, dtype_like) + on_line * fraction
    store(lower, i, p00)
    store(lower, i + across, p01)
    store(upper, j, p10)
    store(upper, j + across, p11)
    store(to_line, m, l0)
    store(to_line, m + across, l1)


@inline
def _add_entries(
    plane: Any, line: Any, k: int, nodes: Any, fractions: Any, first: int, last: int, owned: Any, read: int,
    upstream: Any, summed: bool,
) -> None:  # fmt: skip
    """Add the gradients of a range of listed samples to plane and line ``k``."""
    a, b, v = axes(k)
    columns, channels = plane.shape[1], plane.shape[2]
    to_plane, lower, upper, to_line = owned.plane, owned.lower, owned.upper, owned.line
    down, far, blocks = columns * channels, ENTRY * lookahead(read), read - read % LANES
    for e in range(first, last, ENTRY):
        then = min(e + far, last - ENTRY)
        at = (int64(nodes[then + a]) * columns + int64(nodes[then + b])) * channels
        prefetch_cell(plane, at, channels, down, read)
        prefetch_cell(to_plane, at, channels, down, read)
        if not summed:
            prefetch_row(upstream, (3 * int64(nodes[then + 3]) + k) * channels, read)
        at = (int64(nodes[e + a]) * columns + int64(nodes[e + b])) * channels
        cell = Cell(at, channels, down, cell_weights(fractions[e + a], fractions[e + b]))
        segment = Segment(int64(nodes[e + v]) * channels, channels, fractions[e + v])
        targets = _targets(owned, cell, segment)
        g, n = fractions[e + 3], (3 * int64(nodes[e + 3]) + k) * channels
        for c in range(0, blocks, LANES):
            gc = vector_zero() + g if summed else load(upstream, n + c, vector_zero())
            _add(plane, line, cell, segment, c, gc, lower, upper, to_line, targets, vector_zero())
        for c in range(blocks, read):
            gc = g if summed else load(upstream, n + c, scalar_zero())
            _add(plane, line, cell, segment, c, gc, lower, upper, to_line, targets, scalar_zero())


class _Grids(NamedTuple):
    """Planes, lines and channels to read; gradients of planes, copies of those of lines, and what nobody reads."""

    planes: Any
    lines: Any
    read: Any
    to_planes: Any
    to_lines: Any
    waste: Any


@inline
def _backward(task: int, grids: Any, listing: Any, upstream: Any, summed: bool) -> None:
    k, part = task // TASKS, task % TASKS
    plane, line, to_plane, to_lines = grids.planes[k], grids.lines[k], grids.to_planes[k], grids.to_lines
    starts, nodes, fractions = listing
    channels, z, y, x = (
        line.shape[1],
        grids.lines[0].shape[0],
        grids.lines[1].shape[0],
        grids.lines[2].shape[0],
    )
    line_first = (part * (x + y + z) + (z if k > 0 else 0) + (y if k > 1 else 0)) * channels
    for i in range(line_first, line_first + line.shape[0] * channels):
        to_lines[i] = float32(0)
    samples, stride = nodes.shape[0] // (2 * ENTRY), starts.shape[0] // 2
    a, _, _ = axes(k)
    for third in range(3):
        first, last = span(starts, a * stride, plane.shape[0], part, third)
        lower, upper = third != 0, third != 2
        owned = _Owned(
            to_plane,
            to_plane if lower else grids.waste,
            to_plane if upper else grids.waste,
            to_lines if lower else grids.waste,
            lower, upper, line_first, 2 * task * channels,
        )  # fmt: skip
        first, last = ENTRY * (a * samples + first), ENTRY * (a * samples + last)
        _add_entries(plane, line, k, nodes, fractions, first, last, owned, grids.read, upstream, summed)


@kernel
def _density_backward(
    task: int, xy: Cube[float32], xz: Cube[float32], yz: Cube[float32], z: Matrix[float32], y: Matrix[float32],
    x: Matrix[float32], read: int64, to_xy: Vector[float32], to_xz: Vector[float32], to_yz: Vector[float32],
    to_lines: Vector[float32], waste: Vector[float32], starts: Vector[int64], nodes: Vector[int32],
    fractions: Vector[float32], upstream: Vector[float32],
) -> None:  # fmt: skip
    """Gradients of planes and lines from one number a sample."""
    grids = _Grids((xy, xz, yz), (z, y, x), read, (to_xy, to_xz, to_yz), to_lines, waste)
    _backward(task, grids, (starts, nodes, fractions), upstream, True)


@kernel
def _features_backward(
    task: int, xy: Cube[float32], xz: Cube[float32], yz: Cube[float32], z: Matrix[float32], y: Matrix[float32],
    x: Matrix[float32], read: int64, to_xy: Vector[float32], to_xz: Vector[float32], to_yz: Vector[float32],
    to_lines: Vector[float32], waste: Vector[float32], starts: Vector[int64], nodes: Vector[int32],
    fractions: Vector[float32], upstream: Vector[float32],
) -> None:  # fmt: skip
    """Gradients of planes and lines from one number a channel."""
    grids = _Grids((xy, xz, yz), (z, y, x), read, (to_xy, to_xz, to_yz), to_lines, waste)
    _backward(task, grids, (starts, nodes, fractions), upstream, False)


@kernel
def _bf16_features_backward(
    task: int, xy: Cube[float32], xz: Cube[float32], yz: Cube[float32], z: Matrix[float32], y: Matrix[float32],
    x: Matrix[float32], read: int64, to_xy: Vector[float32], to_xz: Vector[float32], to_yz: Vector[float32],
    to_lines: Vector[float32], waste: Vector[float32], starts: Vector[int64], nodes: Vector[int32],
    fractions: Vector[float32], upstream: Vector[uint16],
) -> None:  # fmt: skip
    """`_features_backward` of gradients in bfloat16."""
    grids = _Grids((xy, xz, yz), (z, y, x), read, (to_xy, to_xz, to_yz), to_lines, waste)
    _backward(task, grids, (starts, nodes, fractions), upstream, False)


def _run(
    compiled: Kernel, u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int, upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:  # fmt: skip
    nodes, channels = [line.shape[0] for line in lines], lines[0].shape[1]
    u, upstream = nonzero_gradients(u, upstream)
    listing = list_by_row(u, upstream, (nodes[2], nodes[1], nodes[0]), 2)
    copies = workspace("copies", TASKS, sum(nodes), channels)
    waste = workspace("waste", 3 * TASKS, 2, channels).zero_()
    launch(
        compiled, 3 * TASKS, *planes, *lines, read, *plane_gradients, copies, waste, *listing, upstream,
        alone=u.shape[0] < ALONE,
    )  # fmt: skip
    return list(torch.split(reduce_sum(copies), nodes))


def density_backward(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int, upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:  # fmt: skip
    """Add to ``plane_gradients`` in place and return the gradients of the lines; upstream ``(N,)``."""
    return _run(_density_backward, u, planes, lines, read, upstream, plane_gradients)


def features_backward(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], read: int, upstream: Tensor,
    plane_gradients: Sequence[Tensor],
) -> list[Tensor]:  # fmt: skip
    """Add to ``plane_gradients`` in place and return the gradients of the lines; upstream ``(N, 3 C)``."""
    compiled = _bf16_features_backward if upstream.dtype == torch.bfloat16 else _features_backward
    return _run(compiled, u, planes, lines, read, upstream, plane_gradients)
