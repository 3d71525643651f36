"""Compiled lookups of CP grids: values and gradients.

A gradient task owns nodes of one line, and computes the product of the other two again: nothing is copied or summed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gridreg.ops.cpu.counting_sort import ALONE, ENTRY, TASKS, list_by_row, nonzero_gradients, span
from gridreg.ops.cpu.grid_coordinates import BATCH, COORDINATES, batch, locate
from gridreg.ops.cpu.interpolation import Segment, linear, lookahead, prefetch_row
from gridreg.ops.cpu.jit.compiler import Kernel, inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, total, vector_zero
from gridreg.ops.cpu.jit.table import Matrix, Vector, float32, int32, int64, scratch
from gridreg.ops.cpu.jit.workspace import workspace


@inline
def segments_of(nodes: Any, fractions: Any, q: int, channels: int) -> Any:
    """Segments of sample ``q`` of a batch on the lines along x, y and z."""
    return (
        Segment(int64(nodes[q]) * channels, channels, fractions[q]),
        Segment(int64(nodes[BATCH + q]) * channels, channels, fractions[BATCH + q]),
        Segment(int64(nodes[2 * BATCH + q]) * channels, channels, fractions[2 * BATCH + q]),
    )


@inline
def _product(lines: Any, segments: Any, c: int, dtype_like: Any) -> Any:
    value = linear(lines[0], segments[0], c, dtype_like)
    value = value * linear(lines[1], segments[1], c, dtype_like)
    return value * linear(lines[2], segments[2], c, dtype_like)


@inline
def product_sum(lines: Any, segments: Any, read: int) -> Any:
    """Sum over channels of the product of three lines."""
    blocks = read - read % LANES
    lanes = vector_zero()
    for c in range(0, blocks, LANES):
        lanes = lanes + _product(lines, segments, c, vector_zero())
    value = total(lanes)
    for c in range(blocks, read):
        value += _product(lines, segments, c, scalar_zero())
    return value


@inline
def _write(lines: Any, segments: Any, read: int, out: Any, to: int) -> None:
    blocks = read - read % LANES
    for c in range(0, blocks, LANES):
        store(out, to + c, _product(lines, segments, c, vector_zero()))
    for c in range(blocks, read):
        store(out, to + c, _product(lines, segments, c, scalar_zero()))
    for c in range(read, segments[0].across):
        out[to + c] = float32(0)


@inline
def _forward(
    task: int, u: Any, lines: Any, read: int, nodes: Any, fractions: Any, out: Any, summed: bool
) -> None:
    """Write the samples of a task; ``lines`` along x, y and z."""
    first, last = batch(task, u.shape[0])
    channels, shape = lines[0].shape[1], (lines[0].shape[0], lines[1].shape[0], lines[2].shape[0])
    locate(nodes, fractions, u, first, last - first, shape)
    for q in range(last - first):
        segments = segments_of(nodes, fractions, q, channels)
        if summed:
            out[first + q] = product_sum(lines, segments, read)
        else:
            _write(lines, segments, read, out, (first + q) * channels)


@kernel
def _density(
    task: int, u: Matrix[float32], z: Matrix[float32], y: Matrix[float32], x: Matrix[float32], read: int64,
    out: Vector[float32],
) -> None:  # fmt: skip
    """Sum over channels of the product of the lines."""
    nodes, fractions = scratch(COORDINATES, int32), scratch(COORDINATES, float32)
    _forward(task, u, (x, y, z), read, nodes, fractions, out, True)


@kernel
def _features(
    task: int, u: Matrix[float32], z: Matrix[float32], y: Matrix[float32], x: Matrix[float32], read: int64,
    out: Vector[float32],
) -> None:  # fmt: skip
    """Product of the lines, channel by channel."""
    nodes, fractions = scratch(COORDINATES, int32), scratch(COORDINATES, float32)
    _forward(task, u, (x, y, z), read, nodes, fractions, out, False)


@inline
def _add(
    first: Any, second: Any, segments: Any, fraction: Any, c: int, g: Any, lower: Any, i: int, upper: Any, j: int,
    dtype_like: Any,
) -> None:  # fmt: skip
    """Add the gradient of channels from ``c`` on of a sample to the nodes at ``i`` and ``j``, from the other lines."""
    value = linear(first, segments[0], c, dtype_like) * g
    value = value * linear(second, segments[1], c, dtype_like)
    below = load(lower, i + c, dtype_like) + value * (float32(1) - fraction)
    above = load(upper, j + c, dtype_like) + value * fraction
    store(lower, i + c, below)
    store(upper, j + c, above)


@inline
def _backward(
    task: int, lines: Any, read: int, gradients: Any, waste: Any, listing: Any, upstream: Any, summed: bool
) -> None:
    """Add the gradients that one task owns; ``lines`` and ``gradients`` along x, y and z."""
    axis, part = task // TASKS, task % TASKS
    b, c_ = 1 if axis == 0 else 0, 1 if axis == 2 else 2
    line_b, line_c, own, (starts, nodes, fractions) = lines[b], lines[c_], gradients[axis], listing
    samples, stride = nodes.shape[0] // (3 * ENTRY), starts.shape[0] // 3
    channels, far, blocks = lines[0].shape[1], ENTRY * lookahead(read), read - read % LANES
    for third in range(3):
        first, last = span(starts, axis * stride, lines[axis].shape[0], part, third)
        # What falls on nodes of another task, which sees these samples too, goes to where nobody reads.
        lower, upper = third != 0, third != 2
        to_lower, to_upper = own if lower else waste, own if upper else waste
        last = ENTRY * (axis * samples + last)
        for e in range(ENTRY * (axis * samples + first), last, ENTRY):
            if not summed:
                prefetch_row(upstream, int64(nodes[min(e + far, last - ENTRY) + 3]) * channels, read)
            segments = (
                Segment(int64(nodes[e + b]) * channels, channels, fractions[e + b]),
                Segment(int64(nodes[e + c_]) * channels, channels, fractions[e + c_]),
            )
            below, fraction, g = int64(nodes[e + axis]) * channels, fractions[e + axis], fractions[e + 3]
            i = below if lower else task * channels
            j = below + channels if upper else task * channels
            n = int64(nodes[e + 3]) * channels
            for c in range(0, blocks, LANES):
                gc = vector_zero() + g if summed else load(upstream, n + c, vector_zero())
                _add(line_b, line_c, segments, fraction, c, gc, to_lower, i, to_upper, j, vector_zero())
            for c in range(blocks, read):
                gc = g if summed else load(upstream, n + c, scalar_zero())
                _add(line_b, line_c, segments, fraction, c, gc, to_lower, i, to_upper, j, scalar_zero())


@kernel
def _density_backward(
    task: int, z: Matrix[float32], y: Matrix[float32], x: Matrix[float32], read: int64, to_z: Vector[float32],
    to_y: Vector[float32], to_x: Vector[float32], waste: Vector[float32], starts: Vector[int64],
    nodes: Vector[int32], fractions: Vector[float32], upstream: Vector[float32],
) -> None:  # fmt: skip
    """Gradients of the lines from one number a sample."""
    _backward(task, (x, y, z), read, (to_x, to_y, to_z), waste, (starts, nodes, fractions), upstream, True)


@kernel
def _features_backward(
    task: int, z: Matrix[float32], y: Matrix[float32], x: Matrix[float32], read: int64, to_z: Vector[float32],
    to_y: Vector[float32], to_x: Vector[float32], waste: Vector[float32], starts: Vector[int64],
    nodes: Vector[int32], fractions: Vector[float32], upstream: Vector[float32],
) -> None:  # fmt: skip
    """Gradients of the lines from one number a channel."""
    _backward(task, (x, y, z), read, (to_x, to_y, to_z), waste, (starts, nodes, fractions), upstream, False)


def density(u: Tensor, lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N,)``; all contiguous float32 on the CPU, ``read`` the number of channels to use."""
    out = torch.empty(u.shape[0])
    launch(_density, -(-u.shape[0] // BATCH), u, *lines, read, out)
    return out


def features(u: Tensor, lines: Sequence[Tensor], read: int) -> Tensor:
    """``(N, C)``; arguments as for `density`."""
    out = torch.empty(u.shape[0], lines[0].shape[1])
    launch(_features, -(-u.shape[0] // BATCH), u, *lines, read, out)
    return out


def _gradients(
    compiled: Kernel, u: Tensor, lines: Sequence[Tensor], read: int, upstream: Tensor
) -> list[Tensor]:
    u, upstream = nonzero_gradients(u, upstream)
    listing = list_by_row(u, upstream, (lines[2].shape[0], lines[1].shape[0], lines[0].shape[0]), 3)
    gradients = [torch.zeros_like(line) for line in lines]
    waste, alone = workspace("waste", 3 * TASKS, lines[0].shape[1]).zero_(), u.shape[0] < ALONE
    launch(compiled, 3 * TASKS, *lines, read, *gradients, waste, *listing, upstream, alone=alone)
    return gradients


def density_backward(u: Tensor, lines: Sequence[Tensor], read: int, upstream: Tensor) -> list[Tensor]:
    """Gradients of the lines; upstream ``(N,)``."""
    return _gradients(_density_backward, u, lines, read, upstream)


def features_backward(u: Tensor, lines: Sequence[Tensor], read: int, upstream: Tensor) -> list[Tensor]:
    """Gradients of the lines; upstream ``(N, C)``."""
    return _gradients(_features_backward, u, lines, read, upstream)
