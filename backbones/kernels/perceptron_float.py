"""The kernels of `backbones.kernels.perceptron` in float32, for processors without dot products of bfloat16."""

from __future__ import annotations

from typing import Any

from backbones.kernels.compiler import (
    float32,
    inline,
    int64,
    integer,
    kernel,
    next_task,
    scratch,
    size,
    vector,
)
from backbones.kernels.dot_blocks import add_rows
from backbones.kernels.encoded_rows import OF_BLOCK, decode_rows, encode_rows
from backbones.kernels.fma_blocks import (
    LONG,
    ROWS,
    SUMMED,
    TASKS,
    WIDEST,
    full_one,
    full_two,
    gate_one,
    gate_two,
    product,
    relu_one,
    relu_two,
    sum_products,
)
from backbones.kernels.simd import store

__all__ = ["backward", "forward"]

# Arguments of a kernel before those of the blocks, and of each layer.
_AHEAD, _BACK, _OF_LAYER = 5, 8, 4
_TILE = SUMMED * WIDEST


@kernel
def forward(table: Any) -> None:
    """Rows, blocks, layers, encoded, out; of blocks x, rows, dims, octaves; of layers packed weight, bias, output,
    columns of the input that count."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, out = vector(table, 3, float32), vector(table, 4, float32)
    layers = _AHEAD + OF_BLOCK * blocks
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * ROWS
        count = min(int64(ROWS), rows - first)
        encode_rows(table, _AHEAD, blocks, first, count, encoded, size(table, 3, 1), store)
        read, width = encoded, size(table, 3, 1)
        for layer in range(depth):
            place = layers + _OF_LAYER * layer
            weight, bias = vector(table, place, float32), vector(table, place + 1, float32)
            columns, taken = LONG * size(table, place, 0), integer(table, place + 3)
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


@inline
def _copy(x: Any, width: Any, first: Any, count: Any, out: Any, wider: Any) -> Any:
    """Copy rows, with zeros behind them."""
    for r in range(count):
        for i in range(wider):
            out[r * wider + i] = x[(first + r) * width + i] if i < width else float32(0)


@kernel
def backward(table: Any) -> None:
    """Rows, blocks, layers, encoded, gradient of out, columns of the encodings' gradient, zeros, sums ``(tasks, S)``;
    of blocks result, first column, dims, octaves; of layers packed transposed weight, input, place of its sum, columns
    of the output that count."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, gradient = vector(table, 3, float32), vector(table, 4, float32)
    given, columns, zeros = size(table, 4, 1), integer(table, 5), vector(table, 6, float32)
    sums, stride = vector(table, 7, float32), size(table, 7, 1)
    layers = _BACK + OF_BLOCK * blocks
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
            _copy(gradient, given, first, count, slope, high)
            for layer in range(depth - 1, -1, -1):
                place = layers + _OF_LAYER * layer
                x, width = vector(table, place + 1, float32), size(table, place + 1, 1)
                at, taken = task * stride + integer(table, place + 2), integer(table, place + 3)
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
                taken = integer(table, layers + 3)
                product(
                    slope, 0, high, taken, count, weight, wider, other, 0, zeros, 0, 1, full_two, full_one
                )
                decode_rows(table, _BACK, blocks, first, count, encoded, size(table, 3, 1), other, wider)
