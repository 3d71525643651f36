"""Matrix products of bfloat16 with float32 sums, one layer at a time, by `gridreg.ops.cpu.mlp.gemm_bf16`.

The matrices of a small perceptron fit into the cache; what costs is the way there: oneDNN prepares each product for its
shape, and torch copies, converts and pads around it. Here a task takes some rows, multiplies them by a matrix that was
packed once, and ends with what the layer needs. Sums over rows, which make the gradient of a weight, are done by a
fixed number of tasks, so that they do not depend on the number of threads.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops.cpu.jit.compiler import (
    float32,
    inline,
    int32,
    int64,
    kernel,
    next_task,
    scratch,
    size,
    uint16,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.mlp.gemm_bf16 import (
    HIGH,
    PAIRS,
    available,
    full_one,
    full_two,
    gate_one,
    gate_two,
    low_one,
    low_two,
    pair_rows,
    product,
    relu_one,
    relu_two,
    sum_products,
    take,
)
from gridreg.ops.cpu.mlp.gemm_tile import ROWS, SUMMED, TASKS, WIDEST
from gridreg.ops.cpu.reductions import add_rows, reduce_sum

__all__ = ["WIDEST", "available", "multiply", "pack", "weight_gradient"]

_FACTORS = ROWS * WIDEST


@inline
def _layer(table: Any, out: Any, more: Any, along: Any, two: Any, one: Any) -> Any:
    """x ``(M, K)``, packed weight ``(N / 16, K / 2, 16)``, out ``(M', N)``; what the ending takes."""
    x, weight = vector(table, 0, uint16), vector(table, 1, int32)
    rows, width = size(table, 0, 0), size(table, 0, 1)
    columns, pairs = 16 * size(table, 1, 0), size(table, 1, 1)
    a = scratch(_FACTORS, uint16)
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * ROWS
        count = min(ROWS, rows - first)
        take(x, width, first, count, pairs, a)
        product(a, 0, pairs, count, weight, columns, out, first * columns, more, 0, along, two, one)


@kernel
def _full(table: Any) -> None:
    """x, packed weight, out in float32, bias: see `_layer`."""
    _layer(table, vector(table, 2, float32), vector(table, 3, float32), 1, full_two, full_one)


@kernel
def _low(table: Any) -> None:
    """x, packed weight, out in bfloat16, bias."""
    _layer(table, vector(table, 2, uint16), vector(table, 3, float32), 1, low_two, low_one)


@kernel
def _relu(table: Any) -> None:
    """x, packed weight, out in bfloat16, bias."""
    _layer(table, vector(table, 2, uint16), vector(table, 3, float32), 1, relu_two, relu_one)


@kernel
def _gate(table: Any) -> None:
    """x, packed weight, out in bfloat16, a ReLU's output in bfloat16, as wide as out."""
    _layer(table, vector(table, 2, uint16), vector(table, 3, uint16), 0, gate_two, gate_one)


@kernel
def _sum_rows(table: Any) -> None:
    """slope ``(M, N)``, x ``(M, K)``, both bfloat16; ``slope^T x (tasks, N', K')`` and sums of slope ``(tasks, N)``."""
    slope, x = vector(table, 0, uint16), vector(table, 1, uint16)
    out, totals = vector(table, 2, float32), vector(table, 3, float32)
    rows, given, taken = size(table, 0, 0), size(table, 0, 1), size(table, 1, 1)
    high, width = size(table, 2, 1), size(table, 2, 2)
    of_slope, of_x = scratch(PAIRS, int32), scratch(PAIRS, int32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        begin, end = rows * task // TASKS, rows * (task + 1) // TASKS
        base, total = task * high * width, task * given
        for i in range(base, base + high * width):
            out[i] = float32(0)
        for n in range(total, total + given):
            totals[n] = float32(0)
        for first in range(begin, end, SUMMED):
            count = min(int64(SUMMED), end - first)
            pairs = -(-count // 2)
            pair_rows(slope, given, first, count, of_slope, 16, high)
            pair_rows(x, taken, first, count, of_x, 16 * pairs, 16)
            add_rows(slope, given, first, count, totals, total)
            sum_products(of_slope, high, of_x, width, pairs, out, base)


def _up(count: int, to: int) -> int:
    return -(-count // to) * to


def pack(weight: Tensor, width: int = 0) -> Tensor:
    """A weight ``(out, in)`` as `multiply` reads it: ``(out / 16, in / 2, 16)`` pairs, both rounded up.

    Args:
        weight: float32.
        width: even; zeros follow the columns up to it.
    """
    rows, columns = weight.shape
    low = weight.detach().to(torch.bfloat16)
    padded = F.pad(low, (0, _up(max(columns, width), 2) - columns, 0, _up(rows, 16) - rows)).contiguous()
    words = padded.view(torch.int32)
    return words.reshape(-1, 16, words.shape[1]).transpose(1, 2).contiguous()


def multiply(
    x: Tensor,
    packed: Tensor,
    *,
    bias: Tensor | None = None,
    relu: bool = False,
    gates: Tensor | None = None,
    dtype: torch.dtype = torch.bfloat16,
) -> Tensor:
    """``x weight^T + bias``.

    Args:
        x: ``(M, K)`` bfloat16, contiguous; K at most `WIDEST`.
        packed: the weight ``(N, K)``, see `pack`; N at most `WIDEST`.
        bias: ``(N,)`` float32.
        relu: of the result, which is then bfloat16.
        gates: what this returned for a ReLU of M rows and N columns: the result, in bfloat16 and without bias, is 0
            where that is not positive.
        dtype: of the result otherwise, float32 or bfloat16.

    Returns:
        Contiguous; at least M rows and N columns, which are rounded up to whole blocks.
    """
    rows, columns = x.shape[0], 16 * packed.shape[0]
    low = relu or gates is not None or dtype == torch.bfloat16
    out = torch.empty(_up(rows, HIGH), columns, dtype=torch.bfloat16 if low else torch.float32)
    if gates is None:
        more = torch.zeros(columns)
        if bias is not None:
            more[: len(bias)] = bias.detach()
        compiled = _relu if relu else (_low if low else _full)
    else:
        more, compiled = gates, _gate
    launch(compiled, -(-rows // ROWS), x, packed, out, more)
    return out


def weight_gradient(slope: Tensor, x: Tensor) -> tuple[Tensor, Tensor]:
    """``slope^T x (N, K)`` and the sum of slope over rows ``(N,)``, float32.

    Args:
        slope: ``(M, N)`` bfloat16, contiguous; N at most `WIDEST`.
        x: ``(M, K)`` bfloat16, contiguous; K at most `WIDEST`.
    """
    out = torch.empty(TASKS, _up(slope.shape[1], 16), _up(x.shape[1], 16))
    totals = torch.empty(TASKS, slope.shape[1])
    launch(_sum_rows, TASKS, slope, x, out, totals)
    return reduce_sum(out)[: slope.shape[1], : x.shape[1]], reduce_sum(totals)
