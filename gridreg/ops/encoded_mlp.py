"""A perceptron on positional encodings, in one pass: the encodings are written in the products' own precision.

One column of ones beside the encodings carries the first bias, so that oneDNN adds it and sums its gradient. Inputs
given by ray are encoded once per ray and copied to the samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gridreg.errors import InputError
from gridreg.ops.cpu.jit.bfloat16 import store_low
from gridreg.ops.cpu.jit.compiler import (
    float32,
    int64,
    integer,
    kernel,
    matrix,
    next_task,
    uint16,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, wide
from gridreg.ops.cpu.mlp.chain import chain_backward, chain_forward
from gridreg.ops.cpu.mlp.fused import Block, fits, perceptron
from gridreg.ops.cpu.mlp.octaves import read_octaves, write_octaves
from gridreg.ops.dispatch import takes_compiled
from gridreg.ops.encode import MOST_OCTAVES, encode, encode_together
from gridreg.ops.linear import Layer, Precision, check_layers, check_precision, mlp, product_dtype

__all__ = ["Block", "encoded_mlp"]

# Rows of one task.
_ROWS = 256


@kernel
def _write(table: Any) -> None:
    """x, sin, cos ``(N, D)``, out ``(M, W)`` in bfloat16, first column, octaves."""
    x, s, c = matrix(table, 0, float32), matrix(table, 1, float32), matrix(table, 2, float32)
    out, at, octaves = matrix(table, 3, uint16), integer(table, 4), integer(table, 5)
    dims = x.shape[1]
    split = dims - dims % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _ROWS, min((task + 1) * _ROWS, x.shape[0])):
            xs, ss, cs, row = x[n], s[n], c[n], out[n]
            for i in range(0, split, LANES):
                value, sine, cosine = load(xs, i, wide()), load(ss, i, wide()), load(cs, i, wide())
                write_octaves(value, sine, cosine, row, at + i, dims, octaves, store_low)
            for i in range(split, dims):
                write_octaves(xs[i], ss[i], cs[i], row, at + i, dims, octaves, store_low)


@kernel
def _copy(table: Any) -> None:
    """Encoded rows ``(R, E)`` in bfloat16, row of each sample ``(N,)``, out ``(M, W)`` in bfloat16, first column."""
    encoded, rows = matrix(table, 0, uint16), vector(table, 1, int64)
    out, at = matrix(table, 2, uint16), integer(table, 3)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _ROWS, min((task + 1) * _ROWS, rows.shape[0])):
            source, row = encoded[rows[n]], out[n]
            for i in range(source.shape[0]):
                row[at + i] = source[i]


@kernel
def _read(table: Any) -> None:
    """Encodings ``(M, W)`` and their gradient ``(M, G)`` in bfloat16, result ``(N, D)``, first column, octaves."""
    x, g, result = matrix(table, 0, uint16), matrix(table, 1, uint16), matrix(table, 2, float32)
    at, octaves = integer(table, 3), integer(table, 4)
    dims = result.shape[1]
    split = dims - dims % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _ROWS, min((task + 1) * _ROWS, result.shape[0])):
            row, slope, into = x[n], g[n], result[n]
            for i in range(0, split, LANES):
                read_octaves(row, at + i, slope, at + i, into, i, dims, octaves, wide())
            for i in range(split, dims):
                read_octaves(row, at + i, slope, at + i, into, i, dims, octaves, one())


def _encode_into(out: Tensor, at: int, x: Tensor, octaves: int) -> None:
    x = x.detach().contiguous()
    sine, cosine = (x.sin(), x.cos()) if octaves else (x, x)
    launch(_write, -(-x.shape[0] // _ROWS), x, sine, cosine, out, at, octaves)


def _encoded(blocks: Sequence[Block], count: int) -> Tensor:
    """``(N, W)`` in bfloat16: the encodings, a column of ones, and zeros; W rounded up."""
    width = sum(block.width for block in blocks)
    out = torch.empty(count, -(-(width + 1) // LANES) * LANES, dtype=torch.bfloat16)
    out[:, width:] = 0
    out[:, width] = 1
    at = 0
    for block in blocks:
        if block.rows is None:
            _encode_into(out, at, block.x, block.octaves)
        else:
            by_row = torch.empty(block.x.shape[0], block.width, dtype=torch.bfloat16)
            _encode_into(by_row, 0, block.x, block.octaves)
            launch(_copy, -(-count // _ROWS), by_row, block.rows.contiguous(), out, at)
        at += block.width
    return out


class _EncodedMLP(Function):
    @staticmethod
    def forward(ctx: Any, blocks: list[Block], count: int, *tensors: Tensor | None) -> Tensor:
        flat = tensors[len(blocks) :]
        blocks = [
            block._replace(x=x) for block, x in zip(blocks, tensors, strict=False) if isinstance(x, Tensor)
        ]
        encoded = _encoded(blocks, count)
        first, bias = flat[0], flat[1]
        assert first is not None
        widened = torch.zeros(first.shape[0], encoded.shape[1])
        widened[:, : first.shape[1]] = first
        if bias is not None:
            widened[:, first.shape[1]] = bias
        layers: list[tuple[Any, Tensor | None]] = [(widened, None)]
        layers += [(flat[i], flat[i + 1]) for i in range(2, len(flat), 2)]
        out, saved = chain_forward(encoded, layers)
        ctx.saved, ctx.blocks, ctx.count = saved, [(b.x.shape[1], b.octaves, b.width) for b in blocks], count
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[2 : 2 + len(ctx.blocks)]
        ends, end = [], 0
        for _, _, width in ctx.blocks:
            end += width
            ends.append(end)
        columns = max((e for e, need in zip(ends, wanted, strict=True) if need), default=0)
        of_x, of_layers = chain_backward(ctx.saved, gradient, columns)
        of_first, width = of_layers[0][0], ends[-1]
        results: list[Tensor | None] = []
        for (dims, octaves, size), end, need in zip(ctx.blocks, ends, wanted, strict=True):
            result = torch.empty(ctx.count, dims) if need else None
            if result is not None:
                tasks = -(-ctx.count // _ROWS)
                launch(_read, tasks, ctx.saved.x, of_x, result, end - size, octaves)
            results.append(result)
        flat = [of_first[:, :width], of_first[:, width]]
        for of_weight, of_bias in of_layers[1:]:
            flat += [of_weight, of_bias]
        needed = ctx.needs_input_grad[2 + len(ctx.blocks) :]
        return (None, None, *results, *(g if n else None for g, n in zip(flat, needed, strict=True)))


def encoded_mlp(
    blocks: Sequence[Block | tuple[Tensor, int]],
    layers: Sequence[Layer | tuple[Tensor, Tensor | None]],
    *,
    precision: Precision = "auto",
) -> Tensor:
    """Linear layers with ReLU between them, on the positional encodings of several inputs, side by side.

    Args:
        blocks: inputs; each is encoded in the order "octave", itself first.
        layers: pairs of weight ``(out, in)`` and bias ``(out,)`` or None; the first reads all encodings.
        precision: see `mlp`.

    Returns:
        ``(N, out)`` of the last layer, without activation; differentiable once.

    Raises:
        InputError: if shapes do not fit.

    Example:
        >>> layer = Layer(torch.ones(1, 5), None)
        >>> rays = Block(torch.tensor([[1.0, 2.0]]), 0, torch.tensor([0, 0]))
        >>> encoded_mlp([(torch.zeros(2, 1), 1), rays], [layer], precision="float32").tolist()
        [[4.0], [4.0]]
    """
    check_precision(precision)
    given = [Block(*block) for block in blocks]
    if not given:
        raise InputError("blocks: found none, expected at least one")
    count = (given[0].x if given[0].rows is None else given[0].rows).shape[0]
    for place, block in enumerate(given):
        found = (block.x if block.rows is None else block.rows).shape[0]
        if block.x.dim() != 2 or found != count or block.octaves < 0:
            shape = tuple(block.x.shape)
            raise InputError(
                f"blocks[{place}]: found x {shape} with {found} samples and {block.octaves} octaves, expected "
                f"(N, D) with {count} samples and at least 0 octaves"
            )
    check_layers(layers, sum(block.width for block in given))
    flat = [tensor for layer in layers for tensor in layer]
    tensors = [block.x for block in given] + [tensor for tensor in flat if tensor is not None]
    dtype = product_dtype(precision)
    fused = (
        takes_compiled(*tensors)
        and count > 0
        and all(block.octaves <= MOST_OCTAVES for block in given)
        and not any(block.x.requires_grad for block in given if block.rows is not None)
    )
    if fused and fits(given, layers, dtype):
        return perceptron(given, count, flat, dtype)
    if fused and dtype == torch.bfloat16:
        out: Tensor = _EncodedMLP.apply(given, count, *(block.x for block in given), *flat)  # type: ignore[no-untyped-call]
        return out
    return _apart(given, layers, precision)


def _apart(blocks: list[Block], layers: Sequence[Any], precision: Precision) -> Tensor:
    """The same step by step; what is given by ray is multiplied by ray."""
    (weight, bias), *others = layers
    by_sample, columns, at = [], [], 0
    offset, rows = bias, None
    for block in blocks:
        part = weight[:, at : at + block.width]
        at += block.width
        # One set of rows can be put off until after the product.
        if block.rows is not None and rows is None:
            offset, rows = F.linear(encode(block.x, block.octaves), part, bias), block.rows
        else:
            x = block.x if block.rows is None else block.x.index_select(0, block.rows)
            by_sample.append((x, block.octaves))
            columns.append(part)
    if not by_sample and rows is not None:
        x = encode(blocks[0].x, blocks[0].octaves).index_select(0, rows)
        return mlp(x, layers, precision=precision)
    joined = columns[0] if len(columns) == 1 else torch.cat(columns, dim=1)
    first = (joined, None if rows is not None else bias)
    x = encode_together(by_sample)
    if rows is None:
        return mlp(x, [first, *others], precision=precision)
    return mlp(x, [first, *others], offset=offset, rows=rows, precision=precision)
