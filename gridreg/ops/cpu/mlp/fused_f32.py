"""The kernels of `gridreg.ops.cpu.mlp.fused` in float32, for processors without dot products of bfloat16."""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.compiler import (
    float32,
    int64,
    integer,
    kernel,
    next_task,
    scratch,
    size,
    vector,
)
from gridreg.ops.cpu.jit.simd import store
from gridreg.ops.cpu.mlp.gemm_f32 import (
    full_one,
    full_two,
    gate_one,
    gate_two,
    product,
    relu_one,
    relu_two,
    sum_products,
)
from gridreg.ops.cpu.mlp.gemm_tile import LONG, ROWS, SUMMED, TASKS, WIDEST
from gridreg.ops.cpu.mlp.rows import (
    AHEAD,
    BACK,
    OF_BLOCK,
    OF_LAYER,
    copy_rows,
    decode_rows,
    encode_rows,
)
from gridreg.ops.cpu.reductions import add_rows

__all__ = ["backward", "forward"]

_TILE = SUMMED * WIDEST


@kernel
def forward(table: Any) -> None:
    """Rows, blocks, layers, encoded, out; of blocks x, rows, dims, octaves; of layers packed weight, bias, output."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, out = vector(table, 3, float32), vector(table, 4, float32)
    layers = AHEAD + OF_BLOCK * blocks
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * ROWS
        count = min(int64(ROWS), rows - first)
        encode_rows(table, AHEAD, blocks, first, count, encoded, size(table, 3, 1), store)
        read, width = encoded, size(table, 3, 1)
        for layer in range(depth):
            place = layers + OF_LAYER * layer
            weight, bias = vector(table, place, float32), vector(table, place + 1, float32)
            columns, taken = LONG * size(table, place, 0), size(table, place, 1)
            at, to = first * width, first * columns
            if layer + 1 < depth:
                hidden = vector(table, place + 2, float32)
                product(
                    read, at, width, taken, count, weight, columns, hidden, to, bias, 0, 1, relu_two, relu_one
                )  # fmt: skip
                read, width = hidden, columns
            else:
                product(
                    read, at, width, taken, count, weight, columns, out, to, bias, 0, 1, full_two, full_one
                )


@kernel
def backward(table: Any) -> None:
    """Rows, blocks, layers, encoded, gradient of out, columns of the encodings' gradient, zeros, sums ``(tasks, S)``;
    of blocks result, first column, dims, octaves; of layers packed transposed weight, input, place of its sum."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, gradient = vector(table, 3, float32), vector(table, 4, float32)
    given, columns, zeros = size(table, 4, 1), integer(table, 5), vector(table, 6, float32)
    sums, stride = vector(table, 7, float32), size(table, 7, 1)
    layers = BACK + OF_BLOCK * blocks
    these, those = scratch(_TILE, float32), scratch(_TILE, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for i in range(task * stride, (task + 1) * stride):
            sums[i] = float32(0)
        end = rows * (task + 1) // TASKS
        for first in range(rows * task // TASKS, end, SUMMED):
            count = min(int64(SUMMED), end - first)
            slope, other, high = these, those, -(-given // LONG) * LONG
            copy_rows(gradient, given, first, count, slope, high)
            for layer in range(depth - 1, -1, -1):
                place = layers + OF_LAYER * layer
                x, width = vector(table, place + 1, float32), size(table, place + 1, 1)
                at, taken = task * stride + integer(table, place + 2), size(table, place, 1)
                sum_products(slope, high, x, first * width, width, count, sums, at, width)
                add_rows(slope, high, 0, count, sums, at + high * width)
                if layer > 0:
                    weight = vector(table, place, float32)
                    product(
                        slope, 0, high, taken, count, weight, width, other, 0, x, first * width, 0, gate_two, gate_one
                    )  # fmt: skip
                    slope, other, high = other, slope, width
            if columns > 0:
                weight, wider = vector(table, layers, float32), LONG * size(table, layers, 0)
                taken = size(table, layers, 1)
                product(
                    slope, 0, high, taken, count, weight, wider, other, 0, zeros, 0, 1, full_two, full_one
                )
                decode_rows(table, BACK, blocks, first, count, encoded, size(table, 3, 1), other, wider)
