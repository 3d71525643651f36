"""A perceptron on positional encodings, forward and backward in one kernel each (AVX-512 BF16).

Layer by layer, as `backbones.kernels.dots` does it, a small network spends a third of its time between products. Here a
task takes some rows through all layers while they are in the nearest cache. Gradients of the weights are summed by a
fixed number of tasks, so that they do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from backbones.kernels.bfloat16 import store_low
from backbones.kernels.compiler import (
    float32,
    inline,
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
from backbones.kernels.dot_blocks import (
    HIGH,
    PAIRS,
    ROWS,
    SUMMED,
    TASKS,
    WIDEST,
    add_rows,
    available,
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
from backbones.kernels.dots import pack
from backbones.kernels.octaves import read_octaves, write_octaves
from backbones.kernels.simd import LANES, load, one, wide
from backbones.kernels.sums import fold
from backbones.kernels.threading import launch
from backbones.kernels.waves import sine_and_cosine
from backbones.kernels.workspace import room

__all__ = ["Block", "fits", "gradients", "perceptron", "rows_of"]

# Arguments of a kernel before those of the blocks, and of each block and layer.
_AHEAD, _BACK = 5, 8
_OF_BLOCK, _OF_LAYER = 4, 3
_TILE = SUMMED * WIDEST


class Block(NamedTuple):
    """One of the inputs of `backbones.kernels.encoded_mlp`.

    Args:
        x: ``(N, D)``, or ``(R, D)`` with ``rows``.
        octaves: of its positional encoding.
        rows: ``(N,)`` int64, the row of ``x`` for each sample; None: its own.
    """

    x: Tensor
    octaves: int
    rows: Tensor | None = None

    @property
    def width(self) -> int:
        """Columns of the encoding."""
        return int(self.x.shape[1]) * (1 + 2 * self.octaves)


@inline
def _encode(table: Any, blocks: Any, first: Any, count: Any, encoded: Any, width: Any) -> Any:
    """Write the encodings of some rows, and zeros behind them."""
    at = int64(0)
    for block in range(blocks):
        place = _AHEAD + _OF_BLOCK * block
        x, rows = vector(table, place, float32), vector(table, place + 1, int64)
        dims, octaves = integer(table, place + 2), integer(table, place + 3)
        by_row = rows.shape[0] > 0
        for n in range(first, first + count):
            source, to = (rows[n] if by_row else n) * dims, n * width + at
            # From the last vector on, as what a vector is too wide belongs to places that are written later.
            for i in range((dims - 1) // LANES * LANES, -1, -LANES):
                value = load(x, source + i, wide())
                sine, cosine = value, value
                if octaves > 0:
                    sine, cosine = sine_and_cosine(value)
                write_octaves(value, sine, cosine, encoded, to + i, dims, octaves, lower)
        at += dims * (1 + 2 * octaves)
    for n in range(first, first + count):
        for i in range(n * width + at, (n + 1) * width):
            encoded[i] = uint16(0)


@kernel
def _forward(table: Any) -> None:
    """Rows, blocks, layers, encoded, out; of blocks x, rows, dims, octaves; of layers packed weight,
    bias, output."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, out = vector(table, 3, uint16), vector(table, 4, float32)
    layers = _AHEAD + _OF_BLOCK * blocks
    while True:
        task = next_task(table)
        if task < 0:
            break
        first = task * ROWS
        count = min(int64(ROWS), rows - first)
        _encode(table, blocks, first, count, encoded, size(table, 3, 1))
        read, pairs = encoded, size(table, 3, 1) // 2
        for layer in range(depth):
            place = layers + _OF_LAYER * layer
            weight, bias = vector(table, place, int32), vector(table, place + 1, float32)
            columns = 16 * size(table, place, 0)
            at, to = first * pairs, first * columns
            if layer + 1 < depth:
                hidden = vector(table, place + 2, uint16)
                product(read, at, pairs, count, weight, columns, hidden, to, bias, 0, 1, relu_two, relu_one)
                read, pairs = hidden, columns // 2
            else:
                product(read, at, pairs, count, weight, columns, out, to, bias, 0, 1, full_two, full_one)


@inline
def _lower(x: Any, width: Any, first: Any, count: Any, out: Any, wider: Any) -> Any:
    """Copy rows of float32 to bfloat16, with zeros behind them."""
    for r in range(count):
        for i in range(wider):
            value = x[(first + r) * width + i] if i < width else float32(0)
            store_low(out, r * wider + i, value)


@inline
def _decode(
    table: Any, blocks: Any, first: Any, count: Any, encoded: Any, width: Any, g: Any, wider: Any
) -> Any:
    """Gradients of the inputs, from those of the encodings."""
    for block in range(blocks):
        place = _BACK + _OF_BLOCK * block
        result, begin = vector(table, place, float32), integer(table, place + 1)
        dims, octaves = integer(table, place + 2), integer(table, place + 3)
        if result.shape[0] == 0:
            continue
        split = dims - dims % LANES
        for r in range(count):
            at, source, to = (first + r) * width + begin, r * wider + begin, (first + r) * dims
            for i in range(0, split, LANES):
                read_octaves(encoded, at + i, g, source + i, result, to + i, dims, octaves, wide())
            for i in range(split, dims):
                read_octaves(encoded, at + i, g, source + i, result, to + i, dims, octaves, one())


@kernel
def _backward(table: Any) -> None:
    """Rows, blocks, layers, encoded, gradient of out, columns of the encodings' gradient, zeros, sums ``(tasks, S)``;
    of blocks result, first column, dims, octaves; of layers packed transposed weight, input, place of its
    sum."""
    rows, blocks, depth = integer(table, 0), integer(table, 1), integer(table, 2)
    encoded, gradient = vector(table, 3, uint16), vector(table, 4, float32)
    given, columns, zeros = size(table, 4, 1), integer(table, 5), vector(table, 6, float32)
    sums, stride = vector(table, 7, float32), size(table, 7, 1)
    layers = _BACK + _OF_BLOCK * blocks
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
            _lower(gradient, given, first, count, slope, high)
            for layer in range(depth - 1, -1, -1):
                place = layers + _OF_LAYER * layer
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
                _decode(table, blocks, first, count, encoded, size(table, 3, 1), other, wider)


def _up(count: int, to: int) -> int:
    return -(-count // to) * to


def rows_of(count: int) -> int:
    """Rows of what passes between layers: whole blocks, also from the first row of any task of the backward pass on."""
    return _up(count, HIGH) + HIGH


def _encoded_width(blocks: Sequence[Block]) -> int:
    """Columns of the encodings and zeros; the last vector that is written may reach beyond its block."""
    return _up(sum(block.width for block in blocks) + LANES - 1, 16)


def fits(blocks: Sequence[Block], layers: Sequence[Any]) -> bool:
    """Whether the processor and the sizes allow it."""
    widest = max(_encoded_width(blocks), *(_up(weight.shape[0], 16) for weight, _ in layers))
    return widest <= WIDEST and available()


def _padded(x: Tensor) -> Tensor:
    """All elements, with room behind them for a whole vector to be read."""
    count = x.numel()
    found = torch.empty(count + LANES)
    found[:count] = x.detach().reshape(-1)
    return found


def gradients(
    inputs: Sequence[Tensor],
    weights: Sequence[Tensor],
    blocks: Sequence[tuple[int, int, int]],
    wanted: Sequence[bool],
    gradient: Tensor,
) -> tuple[list[Tensor | None], list[Tensor]]:
    """The backward pass: of the blocks where wanted, and of each weight and bias.

    Args:
        inputs: of each layer, bfloat16, as the forward pass left them.
        weights: of each layer.
        blocks: dims, octaves and columns of each.
        wanted: whether it has a gradient.
        gradient: ``(N, out)``.
    """
    count, none = len(gradient), torch.empty(0)
    arguments: list[Any] = []
    results: list[Tensor | None] = []
    end = columns = 0
    for (dims, octaves, width), need in zip(blocks, wanted, strict=True):
        results.append(torch.empty(count, dims) if need else None)
        arguments += [results[-1] if need else none, end, dims, octaves]
        end += width
        columns = end if need else columns
    place, places = 0, []
    for number, (weight, x) in enumerate(zip(weights, inputs, strict=True)):
        high = _up(weight.shape[0], 16)
        back = weight if number else weight[:, :columns]
        places.append((place, place + high * x.shape[1], high, x.shape[1]))
        arguments += [pack(back.t(), high) if back.shape[1] else none, x, place]
        place += high * (x.shape[1] + 1)
    sums = room("perceptron", TASKS, place)
    launch(
        _backward, TASKS, count, len(blocks), len(weights), inputs[0], gradient, columns,
        torch.zeros(_up(columns, 16)), sums, *arguments,
    )  # fmt: skip
    found = fold(sums)
    flat: list[Tensor] = []
    for weight, (begin, middle, high, width) in zip(weights, places, strict=True):
        of_weight = found[begin:middle].view(high, width)
        flat += [of_weight[: weight.shape[0], : weight.shape[1]], found[middle : middle + len(weight)]]
    return results, flat


class _Perceptron(Function):
    @staticmethod
    def forward(ctx: Any, blocks: list[Block], count: int, *tensors: Tensor | None) -> Tensor:
        flat = tensors[len(blocks) :]
        width, none = _encoded_width(blocks), torch.empty(0, dtype=torch.int64)
        encoded = torch.empty(rows_of(count), width, dtype=torch.bfloat16)
        arguments: list[Any] = []
        for block in blocks:
            rows = none if block.rows is None else block.rows.contiguous()
            arguments += [_padded(block.x), rows, block.x.shape[1], block.octaves]
        inputs, weights = [encoded], []
        for place in range(0, len(flat), 2):
            weight, bias = flat[place], flat[place + 1]
            assert weight is not None
            weights.append(weight.detach())
            high = _up(weight.shape[0], 16)
            more = torch.zeros(high)
            if bias is not None:
                more[: len(bias)] = bias.detach()
            output = encoded
            if place + 2 < len(flat):
                output = torch.empty(len(encoded), high, dtype=torch.bfloat16)
                inputs.append(output)
            arguments += [pack(weight, inputs[place // 2].shape[1]), more, output]
        out = torch.empty(len(encoded), _up(weights[-1].shape[0], 16))
        tasks = -(-count // ROWS)
        launch(_forward, tasks, count, len(blocks), len(weights), encoded, out, *arguments)
        ctx.inputs, ctx.weights = inputs, weights
        ctx.blocks = [(b.x.shape[1], b.octaves, b.width) for b in blocks]
        return out[:count, : weights[-1].shape[0]].contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[2 : 2 + len(ctx.blocks)]
        needed = ctx.needs_input_grad[2 + len(ctx.blocks) :]
        results, flat = gradients(ctx.inputs, ctx.weights, ctx.blocks, wanted, gradient.contiguous())
        return (None, None, *results, *(g if need else None for g, need in zip(flat, needed, strict=True)))


def perceptron(blocks: list[Block], count: int, flat: Sequence[Tensor | None]) -> Tensor:
    """See `backbones.kernels.encoded_mlp`; blocks and layers that `fits` allows, float32 on the CPU.

    Args:
        blocks: inputs; what has rows has no gradient.
        count: N, not 0.
        flat: weight and bias of each layer, one behind the other.
    """
    out: Tensor = _Perceptron.apply(blocks, count, *(block.x for block in blocks), *flat)  # type: ignore[no-untyped-call]
    return out
