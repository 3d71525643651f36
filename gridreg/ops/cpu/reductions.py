"""What tasks have summed apart, added up; and gradients of which only what counts is left."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from gridreg.ops.cpu.jit.bfloat16 import get
from gridreg.ops.cpu.jit.compiler import (
    float32,
    inline,
    int32,
    int64,
    kernel,
    matrix,
    next_task,
    real,
    size,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, wide

__all__ = ["add_rows", "fold", "thin"]

# Elements of one task.
_PIECE = 4096


@inline
def add_rows(x: Any, width: Any, first: Any, count: Any, totals: Any, total: Any) -> Any:
    """Add rows of x, ``width`` wide, bfloat16 or float32, to the totals from ``total`` on."""
    split = width - width % LANES
    for at in range(first * width, (first + count) * width, width):
        for n in range(0, split, LANES):
            store(totals, total + n, load(totals, total + n, wide()) + get(x, at + n, wide()))
        for n in range(split, width):
            totals[total + n] += get(x, at + n, one())


@inline
def _fold_step(x: Any, out: Any, i: int, parts: int, stride: int, zero: Any) -> None:
    total = zero
    for part in range(parts):
        total = total + load(x, part * stride + i, zero)
    store(out, i, total)


@kernel
def _fold(table: Any) -> None:
    """Parts ``(T, M)``, their sum ``(M,)``."""
    x, out = vector(table, 0, float32), vector(table, 1, float32)
    parts, stride = size(table, 0, 0), size(table, 0, 1)
    while True:
        task = next_task(table)
        if task < 0:
            break
        first, last = task * _PIECE, min((task + 1) * _PIECE, stride)
        split = last - (last - first) % LANES
        for i in range(first, split, LANES):
            _fold_step(x, out, i, parts, stride, wide())
        for i in range(split, last):
            _fold_step(x, out, i, parts, stride, one())


def fold(parts: Tensor) -> Tensor:
    """Sum over the first axis of a contiguous float32 tensor, one part after another."""
    out = torch.empty(parts.shape[1:])
    launch(_fold, -(-out.numel() // _PIECE), parts.view(len(parts), -1), out)
    return out


@kernel
def _measure(table: Any) -> None:
    """Values, sum of their sizes by task ``(tasks, 1)``."""
    x, sums = vector(table, 0, float32), matrix(table, 1, np.float64)
    while True:
        task = next_task(table)
        if task < 0:
            break
        total = 0.0
        for n in range(task * _PIECE, min((task + 1) * _PIECE, x.shape[0])):
            total += abs(x[n])
        sums[task, 0] = total


@inline
def _mixed(bits: Any, place: Any) -> Any:
    """Thirty-two bits that look random: the finalizer of MurmurHash3 (Appleby 2011)."""
    low = int64(0xFFFFFFFF)
    h = (bits ^ (place * int64(0x9E3779B1))) & low
    h = ((h ^ (h >> 16)) * int64(0x85EBCA6B)) & low
    h = ((h ^ (h >> 13)) * int64(0xC2B2AE35)) & low
    return h ^ (h >> 16)


@kernel
def _thin(table: Any) -> None:
    """Values, the same as integers, floor: values below it become 0 or the floor."""
    x, bits, floor = vector(table, 0, float32), vector(table, 1, int32), real(table, 2)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _PIECE, min((task + 1) * _PIECE, x.shape[0])):
            value = np.float64(x[n])
            if abs(value) < floor:
                drawn = np.float64(_mixed(int64(bits[n]), n)) * 2.0**-32 * floor
                kept = floor if value > 0 else -floor
                x[n] = float32(kept) if drawn < abs(value) else float32(0)


def thin(values: Tensor, share: float) -> Tensor:
    """Round small values at random, so that most are 0 and their expectation stays.

    A value smaller than the floor, ``share`` of the mean size, becomes the floor with its sign with probability
    ``size / floor``, and 0 otherwise. The draw comes from the value's own bits and its place: the same values are
    rounded in the same way.

    Args:
        values: ``(N,)`` contiguous float32; overwritten.
        share: of the mean size; 0: nothing changes.
    """
    if share <= 0 or not values.numel():
        return values
    tasks = -(-values.numel() // _PIECE)
    sums = torch.empty(tasks, 1, dtype=torch.float64)
    launch(_measure, tasks, values, sums)
    floor = share * float(sums.sum()) / values.numel()
    launch(_thin, tasks, values, values.view(torch.int32), floor)
    return values
