"""Sums over parts that tasks have written apart, and stochastic rounding of small gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from gridreg.ops.cpu.jit.compiler import inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, scalar_zero, store, vector_zero
from gridreg.ops.cpu.jit.table import Matrix, Vector, float32, float64, int32, int64

# Elements of one task.
_PIECE = 4096


@inline
def add_rows(x: Any, width: Any, first: Any, count: Any, totals: Any, total: Any) -> Any:
    """Add rows of x, ``width`` wide, bfloat16 or float32, to the totals from ``total`` on."""
    split = width - width % LANES
    for at in range(first * width, (first + count) * width, width):
        for n in range(0, split, LANES):
            store(totals, total + n, load(totals, total + n, vector_zero()) + load(x, at + n, vector_zero()))
        for n in range(split, width):
            totals[total + n] += load(x, at + n, scalar_zero())


@inline
def _reduce_step(x: Any, out: Any, i: int, parts: int, stride: int, zero: Any) -> None:
    total = zero
    for part in range(parts):
        total = total + load(x, part * stride + i, zero)
    store(out, i, total)


@kernel
def _reduce(task: int, x: Vector[float32], out: Vector[float32]) -> None:
    """Add up parts ``(T, M)`` to ``(M,)``."""
    stride = out.shape[0]
    parts = x.shape[0] // stride
    first, last = task * _PIECE, min((task + 1) * _PIECE, stride)
    split = last - (last - first) % LANES
    for i in range(first, split, LANES):
        _reduce_step(x, out, i, parts, stride, vector_zero())
    for i in range(split, last):
        _reduce_step(x, out, i, parts, stride, scalar_zero())


def reduce_sum(parts: Tensor) -> Tensor:
    """Sum over the first axis of a contiguous float32 tensor, one part after another."""
    out = torch.empty(parts.shape[1:])
    launch(_reduce, -(-out.numel() // _PIECE), parts.view(len(parts), -1), out)
    return out


@kernel
def _measure(task: int, x: Vector[float32], sums: Matrix[float64]) -> None:
    """Add up the sizes of values by task, ``(tasks, 1)``."""
    total = 0.0
    for n in range(task * _PIECE, min((task + 1) * _PIECE, x.shape[0])):
        total += abs(x[n])
    sums[task, 0] = total


@inline
def _mixed(bits: Any, index: Any) -> Any:
    """Thirty-two bits that look random: the finalizer of MurmurHash3 (Appleby 2011)."""
    low = int64(0xFFFFFFFF)
    h = (bits ^ (index * int64(0x9E3779B1))) & low
    h = ((h ^ (h >> 16)) * int64(0x85EBCA6B)) & low
    h = ((h ^ (h >> 13)) * int64(0xC2B2AE35)) & low
    return h ^ (h >> 16)


@kernel
def _round(task: int, x: Vector[float32], bits: Vector[int32], floor: float32) -> None:
    """Make of values below the floor 0 or the floor; ``bits`` are the values as integers."""
    for n in range(task * _PIECE, min((task + 1) * _PIECE, x.shape[0])):
        value = float64(x[n])
        if abs(value) < floor:
            drawn = float64(_mixed(int64(bits[n]), n)) * 2.0**-32 * floor
            kept = floor if value > 0 else -floor
            x[n] = float32(kept) if drawn < abs(value) else float32(0)


def round_stochastically(values: Tensor, fraction: float) -> Tensor:
    """Stochastic rounding of small values, so that most are 0 and their expectation stays.

    A value smaller than the floor, ``fraction`` of the mean size, becomes the floor with its sign with probability
    ``size / floor``, and 0 otherwise. The draw comes from the value's own bits and its index: the same values are
    rounded in the same way.

    Args:
        values: ``(N,)`` contiguous float32; overwritten.
        fraction: of the mean size; 0: nothing changes.
    """
    if fraction <= 0 or not values.numel():
        return values
    tasks = -(-values.numel() // _PIECE)
    sums = torch.empty(tasks, 1, dtype=torch.float64)
    launch(_measure, tasks, values, sums)
    floor = fraction * float(sums.sum()) / values.numel()
    launch(_round, tasks, values, values.view(torch.int32), floor)
    return values
