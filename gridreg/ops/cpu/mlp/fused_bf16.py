"""The kernels of `gridreg.ops.cpu.mlp.fused` in bfloat16, by the processor's dot products (AVX-512 BF16)."""

from __future__ import annotations

from typing import Any

from gridreg.ops.cpu.jit.compiler import (
    float32,
    int32,
    int64,
    integer,
    kernel,
    next_task,
    scratch,
    size,
    uint16,
    vector,
)
from gridreg.ops.cpu.mlp.gemm_bf16 import (
    PAIRS,
    full_one,
    full_two,
    gate_one,
    gate_two,
    low_one,
    low_two,
    lower,
    pair_rows,
    product,
    relu_one,
    relu_two,
    sum_products,
)
from gridreg.ops.cpu.mlp.gemm_tile import ROWS, SUMMED, TASKS, WIDEST
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
    """Rows, blocks, layers, encoded, out; of blocks x, rows, dims, octaves; of layers packed weight,
    bias, output."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, out = vector(table, 3, uint16), vector(table, 4, float32)
    layers = AHEAD + OF_BLOCK * blocks
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * ROWS
        count = min(int64(ROWS), rows - first)
        encode_rows(table, AHEAD, blocks, first, count, encoded, size(table, 3, 1), lower)
        read, pairs = encoded, size(table, 3, 1) // 2
        for layer in range(depth):
            place = layers + OF_LAYER * layer
            weight, bias = vector(table, place, int32), vector(table, place + 1, float32)
            columns = 16 * size(table, place, 0)
            at, to = first * pairs, first * columns
            if layer + 1 < depth:
                hidden = vector(table, place + 2, uint16)
                product(read, at, pairs, count, weight, columns, hidden, to, bias, 0, 1, relu_two, relu_one)
                read, pairs = hidden, columns // 2
            else:
                product(read, at, pairs, count, weight, columns, out, to, bias, 0, 1, full_two, full_one)


@kernel
def backward(table: Any) -> None:
    """Rows, blocks, layers, encoded, gradient of out, columns of the encodings' gradient, zeros, sums ``(tasks, S)``;
    of blocks result, first column, dims, octaves; of layers packed transposed weight, input, place of its
    sum."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, gradient = vector(table, 3, uint16), vector(table, 4, float32)
    given, columns, zeros = size(table, 4, 1), integer(table, 5), vector(table, 6, float32)
    sums, stride = vector(table, 7, float32), size(table, 7, 1)
    layers = BACK + OF_BLOCK * blocks
    these, those = scratch(_TILE, uint16), scratch(_TILE, uint16)
    of_slope, of_x = scratch(PAIRS, int32), scratch(PAIRS, int32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for i in range(task * stride, (task + 1) * stride):
            sums[i] = float32(0)
        end = rows * (task + 1) // TASKS
        for first in range(rows * task // TASKS, end, SUMMED):
            count = min(int64(SUMMED), end - first)
            pairs = -(-count // 2)
            slope, other, high = these, those, -(-given // 16) * 16
            copy_rows(gradient, given, first, count, slope, high)
            for layer in range(depth - 1, -1, -1):
                place = layers + OF_LAYER * layer
                x, width = vector(table, place + 1, uint16), size(table, place + 1, 1)
                at = task * stride + integer(table, place + 2)
                pair_rows(slope, high, 0, count, of_slope, 16, high)
                pair_rows(x, width, first, count, of_x, 16 * pairs, 16)
                sum_products(of_slope, high, of_x, width, pairs, sums, at)
                add_rows(slope, high, 0, count, sums, at + high * width)
                if layer > 0:
                    weight = vector(table, place, int32)
                    product(
                        slope, 0, high // 2, count, weight, width, other, 0, x, first * width, 0, gate_two, gate_one
                    )  # fmt: skip
                    slope, other, high = other, slope, width
            if columns > 0:
                weight, wider = vector(table, layers, int32), 16 * size(table, layers, 0)
                product(slope, 0, high // 2, count, weight, wider, other, 0, zeros, 0, 1, low_two, low_one)
                decode_rows(table, BACK, blocks, first, count, encoded, size(table, 3, 1), other, wider)
