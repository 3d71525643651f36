"""Kernels of a perceptron on positional encodings, in float32 and in bfloat16: one forward, one backward.

A task takes some rows through all layers while they are in the nearest caches.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from numba import njit
from torch import Tensor

from gridreg.ops.cpu.jit.compiler import kernel
from gridreg.ops.cpu.jit.simd import store
from gridreg.ops.cpu.jit.table import float32, int32, int64, integer, next_task, scratch, size, uint16, vector
from gridreg.ops.cpu.mlp.encodings import PER_BLOCK, copy_rows, decode_rows, encode_rows
from gridreg.ops.cpu.mlp.gemm import (
    GRADIENT_ROWS,
    PAIRS,
    ROWS,
    TASKS,
    WIDEST,
    add_weight_gradient_bf16,
    add_weight_gradient_f32,
    bias_bf16,
    bias_f32,
    prepare_bf16,
    prepare_f32,
    relu_bf16,
    relu_f32,
    relu_mask_bf16,
    relu_mask_f32,
    round_to_bf16,
)
from gridreg.ops.cpu.mlp.gemm_tile import COLUMNS
from gridreg.ops.cpu.reductions import add_rows

_PER_LAYER = 3
# Pasted into a kernel before it is compiled: as functions of their own they would be optimised twice.
_pasted = njit(inline="always")
_FORWARD_TILE, _TILE = ROWS * WIDEST, GRADIENT_ROWS * WIDEST


class ForwardArguments(NamedTuple):
    """First arguments of a forward kernel.

    Behind them stand those of each block of encodings (`encode_rows`), and of each layer: packed weight,
    bias, output. Without blocks the first layer reads what stands in ``encoded``, which then may end with the
    last row.
    """

    rows: int
    blocks: int
    layers: int
    encoded: Tensor
    out: Tensor


class BackwardArguments(NamedTuple):
    """First arguments of a backward kernel.

    Behind them stand those of each block of encodings (`decode_rows`), and of each layer: packed transposed
    weight, input, and where the sums for its weight and then its bias begin in a row of ``sums (tasks, S)``.
    Without blocks the gradient of ``encoded`` is written as it is. ``columns``: of that gradient, as many as
    are wanted.
    """

    rows: int
    blocks: int
    layers: int
    encoded: Tensor
    gradient: Tensor
    columns: int
    zeros: Tensor
    sums: Tensor
    encoded_gradient: Tensor


_AHEAD, _BACK_AHEAD = len(ForwardArguments._fields), len(BackwardArguments._fields)
_ROW_COUNT, _BLOCKS, _LAYERS, _ENCODED, _OUT = range(_AHEAD)
_GRADIENT, _WANTED, _ZEROS, _SUMS, _ENCODED_GRADIENT = range(4, _BACK_AHEAD)


@_pasted
def _forward(
    table: Any, dtype: Any, packed: Any, per_step: int, write: Any, relu: Any, last: Any, prepare: Any
) -> None:
    row_count, blocks, depth = integer(table, _ROW_COUNT), integer(table, _BLOCKS), integer(table, _LAYERS)
    encoded, out = vector(table, _ENCODED, dtype), vector(table, _OUT, float32)
    copied = scratch(_FORWARD_TILE, dtype)
    prepare()
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * ROWS
        rows = min(int64(ROWS), row_count - first)
        x, width, start = encoded, size(table, _ENCODED, 1), first * size(table, _ENCODED, 1)
        if blocks > 0:
            encode_rows(table, _AHEAD, blocks, first, rows, encoded, width, write)
        elif rows < ROWS:
            # Products read whole tiles, and here nothing stands behind the last row.
            copy_rows(encoded, width, first, rows, copied, 0, width)
            x, start = copied, int64(0)
        for layer in range(depth):
            place = _AHEAD + PER_BLOCK * blocks + _PER_LAYER * layer
            weight, bias = vector(table, place, packed), vector(table, place + 1, float32)
            columns, steps = COLUMNS * size(table, place, 0), size(table, place, 1)
            at, step, to = start // per_step, width // per_step, first * columns
            if layer + 1 < depth:
                hidden = vector(table, place + 2, dtype)
                relu(x, at, step, rows, weight, steps, columns, hidden, to, bias, 0)
                x, width, start = hidden, columns, to
            else:
                last(x, at, step, rows, weight, steps, columns, out, to, bias, 0)


@_pasted
def _backward(
    table: Any,
    dtype: Any,
    packed: Any,
    per_step: int,
    add_weight_gradient: Any,
    relu_mask: Any,
    last: Any,
    prepare: Any,
) -> None:
    row_count, blocks, depth = integer(table, _ROW_COUNT), integer(table, _BLOCKS), integer(table, _LAYERS)
    encoded, encoded_width = vector(table, _ENCODED, dtype), size(table, _ENCODED, 1)
    gradient, gradient_width = vector(table, _GRADIENT, float32), size(table, _GRADIENT, 1)
    wanted, zeros = integer(table, _WANTED), vector(table, _ZEROS, float32)
    sums, stride = vector(table, _SUMS, float32), size(table, _SUMS, 1)
    encoded_gradient = vector(table, _ENCODED_GRADIENT, dtype)
    layers = _BACK_AHEAD + PER_BLOCK * blocks
    these, those = scratch(_TILE, dtype), scratch(_TILE, dtype)
    slope_pairs, x_pairs = scratch(PAIRS, int32), scratch(PAIRS, int32)
    prepare()
    while True:
        task = next_task(table)
        if task < 0:
            break
        for i in range(task * stride, (task + 1) * stride):
            sums[i] = float32(0)
        end = row_count * (task + 1) // TASKS
        for first in range(row_count * task // TASKS, end, GRADIENT_ROWS):
            rows = min(int64(GRADIENT_ROWS), end - first)
            slope, other, slope_width = these, those, -(-gradient_width // COLUMNS) * COLUMNS
            copy_rows(gradient, gradient_width, first, rows, slope, 0, slope_width)
            for layer in range(depth - 1, -1, -1):
                place = layers + _PER_LAYER * layer
                x, width = vector(table, place + 1, dtype), size(table, place + 1, 1)
                at = task * stride + integer(table, place + 2)
                add_weight_gradient(slope, slope_width, x, width, first, rows, sums, at, slope_pairs, x_pairs)
                add_rows(slope, slope_width, 0, rows, sums, at + slope_width * width)
                weight, steps = vector(table, place, packed), size(table, place, 1)
                step = slope_width // per_step
                if layer > 0:
                    relu_mask(slope, 0, step, rows, weight, steps, width, other, 0, x, first * width)
                    slope, other, slope_width = other, slope, width
                elif wanted > 0:
                    columns = COLUMNS * size(table, place, 0)
                    last(slope, 0, step, rows, weight, steps, columns, other, 0, zeros, 0)
                    if blocks > 0:
                        decode_rows(
                            table, _BACK_AHEAD, blocks, first, rows, encoded, encoded_width, other, columns
                        )
                    else:
                        copy_rows(other, columns, 0, rows, encoded_gradient, first, encoded_width)


@kernel
def forward_f32(table: Any) -> None:
    """`ForwardArguments`, in float32."""
    _forward(table, float32, float32, 1, store, relu_f32, bias_f32, prepare_f32)


@kernel
def forward_bf16(table: Any) -> None:
    """`ForwardArguments`, in bfloat16."""
    _forward(table, uint16, int32, 2, round_to_bf16, relu_bf16, bias_bf16, prepare_bf16)


@kernel
def backward_f32(table: Any) -> None:
    """`BackwardArguments`, in float32."""
    _backward(table, float32, float32, 1, add_weight_gradient_f32, relu_mask_f32, bias_f32, prepare_f32)


@kernel
def backward_bf16(table: Any) -> None:
    """`BackwardArguments`, in bfloat16."""
    _backward(table, uint16, int32, 2, add_weight_gradient_bf16, relu_mask_bf16, bias_bf16, prepare_bf16)
