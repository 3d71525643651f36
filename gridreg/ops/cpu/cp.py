"""Compiled lookups of CP grids: values and gradients.

A gradient task owns nodes of one line, and computes the product of the other two again: nothing is copied or summed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from gridreg.ops.cpu.counting_sort import ALONE, ENTRY, TASKS, felt, list_by_row, span
from gridreg.ops.cpu.grid_coordinates import BATCH, PLACES, batch, find
from gridreg.ops.cpu.interpolation import ahead, linear, prefetch_row
from gridreg.ops.cpu.jit.compiler import (
    Kernel,
    float32,
    inline,
    int32,
    int64,
    integer,
    kernel,
    next_task,
    scratch,
    size,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, total, wide
from gridreg.ops.cpu.jit.workspace import room

__all__ = ["density", "density_backward", "features", "features_backward", "product_sum"]


@inline
def _product(lines: Any, at: Any, shares: Any, channels: Any, c: Any, like: Any) -> Any:
    value = linear(lines[0], at[0] + c, channels, shares[0], like)
    value = value * linear(lines[1], at[1] + c, channels, shares[1], like)
    return value * linear(lines[2], at[2] + c, channels, shares[2], like)


@inline
def product_sum(lines: Any, at: Any, shares: Any, channels: Any, read: Any) -> Any:
    """Sum over channels of the product of three lines whose channels begin at elements ``at``."""
    blocks = read - read % LANES
    lanes = wide()
    for c in range(0, blocks, LANES):
        lanes = lanes + _product(lines, at, shares, channels, c, wide())
    value = total(lanes)
    for c in range(blocks, read):
        value += _product(lines, at, shares, channels, c, one())
    return value


@inline
def _write(lines: Any, at: Any, shares: Any, channels: Any, read: Any, out: Any, to: Any) -> Any:
    blocks = read - read % LANES
    for c in range(0, blocks, LANES):
        store(out, to + c, _product(lines, at, shares, channels, c, wide()))
    for c in range(blocks, read):
        store(out, to + c, _product(lines, at, shares, channels, c, one()))
    for c in range(read, channels):
        out[to + c] = float32(0)


@inline
def _forward(table: Any, summed: Any) -> Any:
    u, read, out = vector(table, 0, float32), integer(table, 4), vector(table, 5, float32)
    # Along x, y and z: line k lies along axis 2 - k.
    lines = vector(table, 3, float32), vector(table, 2, float32), vector(table, 1, float32)
    shape = size(table, 3, 0), size(table, 2, 0), size(table, 1, 0)
    samples, channels = size(table, 0, 0), size(table, 1, 1)
    nodes, shares = scratch(PLACES, int32), scratch(PLACES, float32)
    places = nodes, shares
    while True:
        task = next_task(table)
        if task < 0:
            break
        first, last = batch(task, samples)
        find(places, u, first, last - first, shape)
        for q in range(last - first):
            x, y, z = int64(nodes[q]), int64(nodes[BATCH + q]), int64(nodes[2 * BATCH + q])
            at = x * channels, y * channels, z * channels
            between = shares[q], shares[BATCH + q], shares[2 * BATCH + q]
            if summed:
                out[first + q] = product_sum(lines, at, between, channels, read)
            else:
                _write(lines, at, between, channels, read, out, (first + q) * channels)


@kernel
def _density(table: Any) -> None:
    """u, three lines, channels to read, out."""
    _forward(table, True)


@kernel
def _features(table: Any) -> None:
    """u, three lines, channels to read, out."""
    _forward(table, False)


@inline
def _add(
    lines: Any,
    at: Any,
    shares: Any,
    g: Any,
    share: Any,
    to: Any,
    i: Any,
    j: Any,
    channels: Any,
    c: Any,
    like: Any,
) -> Any:
    """Add the gradient of some channels of a sample to the node below and the node above."""
    value = linear(lines[0], at[0] + c, channels, shares[0], like) * g
    value = value * linear(lines[1], at[1] + c, channels, shares[1], like)
    below = load(to[0], i + c, like) + value * (float32(1) - share)
    above = load(to[1], j + c, like) + value * share
    store(to[0], i + c, below)
    store(to[1], j + c, above)


@inline
def _serve(
    lines: Any,
    others: Any,
    axis: Any,
    to: Any,
    keep: Any,
    base: Any,
    listing: Any,
    entries: Any,
    channels: Any,
    read: Any,
    upstream: Any,
    summed: Any,
) -> Any:
    """Add the gradients of a range of entries; what is not kept goes to the first elements after its base."""
    nodes, shares = listing
    blocks = read - read % LANES
    far = ENTRY * ahead(read)
    for e in range(entries[0], entries[1], ENTRY):
        if not summed:
            then = min(e + far, entries[1] - ENTRY)
            prefetch_row(upstream, int64(nodes[then + 3]) * channels, read)
        at = int64(nodes[e + others[0]]) * channels, int64(nodes[e + others[1]]) * channels
        between = shares[e + others[0]], shares[e + others[1]]
        below, share, g = int64(nodes[e + axis]) * channels, shares[e + axis], shares[e + 3]
        i, j = base[0] + (below & keep[0]), base[1] + ((below + channels) & keep[1])
        n = int64(nodes[e + 3]) * channels
        for c in range(0, blocks, LANES):
            gc = wide() + g if summed else load(upstream, n + c, wide())
            _add(lines, at, between, gc, share, to, i, j, channels, c, wide())
        for c in range(blocks, read):
            gc = g if summed else load(upstream, n + c, one())
            _add(lines, at, between, gc, share, to, i, j, channels, c, one())


@inline
def _backward(table: Any, summed: Any) -> Any:
    read, upstream = integer(table, 4), vector(table, 5, float32)
    starts, nodes, shares = vector(table, 9, int64), vector(table, 10, int32), vector(table, 11, float32)
    channels, samples, stride = size(table, 1, 1), size(table, 0, 0), size(table, 9, 1)
    waste = vector(table, 12, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        axis, part = task // TASKS, task % TASKS
        others = 1 if axis == 0 else 0, 1 if axis == 2 else 2
        lines = vector(table, 3 - others[0], float32), vector(table, 3 - others[1], float32)
        own = vector(table, 8 - axis, float32)
        for where in range(3):
            first, last = span(starts, axis * stride, size(table, 3 - axis, 0), part, where)
            # What falls on nodes of another task, which sees these samples too, goes to waste.
            low, high = where != 0, where != 2
            to = own if low else waste, own if high else waste
            keep = int64(-1 if low else 0), int64(-1 if high else 0)
            base = int64(0 if low else task * channels), int64(0 if high else task * channels)
            entries = ENTRY * (axis * samples + first), ENTRY * (axis * samples + last)
            _serve(
                lines,
                others,
                axis,
                to,
                keep,
                base,
                (nodes, shares),
                entries,
                channels,
                read,
                upstream,
                summed,
            )


@kernel
def _density_backward(table: Any) -> None:
    """u, three lines, channels to read, upstream, three line gradients, listing, waste."""
    _backward(table, True)


@kernel
def _features_backward(table: Any) -> None:
    """Arguments as of `_density_backward`."""
    _backward(table, False)


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
    u, upstream = felt(u, upstream)
    listing = list_by_row(u, upstream, (lines[2].shape[0], lines[1].shape[0], lines[0].shape[0]), 3)
    gradients = [torch.zeros_like(line) for line in lines]
    waste = room("waste", 3 * TASKS, lines[0].shape[1]).zero_()
    launch(
        compiled, 3 * TASKS, u, *lines, read, upstream, *gradients, *listing, waste, alone=u.shape[0] < ALONE
    )
    return gradients


def density_backward(u: Tensor, lines: Sequence[Tensor], read: int, upstream: Tensor) -> list[Tensor]:
    """Gradients of the lines; upstream ``(N,)``."""
    return _gradients(_density_backward, u, lines, read, upstream)


def features_backward(u: Tensor, lines: Sequence[Tensor], read: int, upstream: Tensor) -> list[Tensor]:
    """Gradients of the lines; upstream ``(N, C)``."""
    return _gradients(_features_backward, u, lines, read, upstream)
