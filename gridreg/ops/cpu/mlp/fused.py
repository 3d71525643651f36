"""A perceptron on positional encodings as one operation of autograd: a kernel forward, a kernel backward.

Layer by layer a small network spends a third of its time between products. Gradients of weights are summed by
a fixed number of tasks, so that they do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES
from gridreg.ops.cpu.jit.workspace import workspace
from gridreg.ops.cpu.mlp import kernels
from gridreg.ops.cpu.mlp.encodings import MOST_OCTAVES
from gridreg.ops.cpu.mlp.gemm import ROWS, TASKS, TILE_ROWS, WIDEST, pack, round_up
from gridreg.ops.cpu.mlp.gemm_tile import has
from gridreg.ops.cpu.reductions import reduce_sum
from gridreg.ops.dispatch import is_cpu_float32
from gridreg.ops.perceptron import Block, Precision, encoded_mlp, product_dtype

_KERNELS = {
    torch.float32: (kernels.forward_f32, kernels.backward_f32),
    torch.bfloat16: (kernels.forward_bf16, kernels.backward_bf16),
}


def padded_rows(count: int) -> int:
    """Rows to allocate, so that whole tiles can be read from any row on at which a task begins."""
    return round_up(count, TILE_ROWS) + TILE_ROWS


def _encoded_width(blocks: Sequence[Block]) -> int:
    """Columns of the encodings and zeros; the last vector that is written may reach beyond its block."""
    return round_up(sum(block.width for block in blocks) + LANES - 1, 16)


def _as_it_is(blocks: Sequence[Block], dtype: torch.dtype) -> bool:
    """Whether the first layer can read the input itself."""
    (x, octaves, rows), *others = blocks
    return not (others or octaves or rows is not None or x.shape[1] % 16) and x.dtype == dtype


def _suits(blocks: Sequence[Any], layers: Sequence[Any], *, precision: Precision = "auto") -> bool:
    """Whether the kernels take these inputs, weights and precision of the products."""
    given, dtype = [Block(*block) for block in blocks], product_dtype(precision)
    as_it_is = _as_it_is(given, dtype)
    alone = len(given) == 1 and given[0].octaves == 0 and given[0].rows is None
    width = given[0].width if as_it_is else _encoded_width(given)
    return (
        is_cpu_float32([] if alone and given[0].x.dtype == dtype != torch.float32 else given, layers)
        and given[0].x.is_cpu
        and max(width, *(round_up(len(weight), 16) for weight, _ in layers)) <= WIDEST
        and all(block.octaves <= MOST_OCTAVES for block in given)
        and not any(block.x.requires_grad for block in given if block.rows is not None)
        # One product in float32 has nothing to fuse.
        and not (alone and len(layers) == 1 and dtype == torch.float32)
        and len(given[0].x if given[0].rows is None else given[0].rows) > 0
    )


def _whole_vectors(x: Tensor) -> Tensor:
    """All elements, of which a whole vector can be read from any multiple of `LANES` in a row on."""
    x = x.detach().float().contiguous()
    return x if x.shape[1] % LANES == 0 else F.pad(x.view(-1), (0, LANES))


def gradients(
    inputs: Sequence[Tensor],
    weights: Sequence[Tensor],
    blocks: Sequence[tuple[int, int, int]],
    wanted: Sequence[bool],
    gradient: Tensor,
) -> tuple[list[Tensor | None], list[Tensor]]:
    """The backward pass: of the blocks where wanted, and of each weight and bias.

    Args:
        inputs: of each layer, as the forward pass left them; their precision is that of the products.
        weights: of each layer.
        blocks: dims, octaves and columns of each; none: of the first layer's input itself.
        wanted: whether it has a gradient.
        gradient: ``(N, out)``.
    """
    count, dtype, none = len(gradient), inputs[0].dtype, torch.empty(0)
    encoded_gradient = torch.empty_like(inputs[0] if wanted[0] and not blocks else none, dtype=dtype)
    arguments: list[Any] = []
    results: list[Tensor | None] = [] if blocks else [encoded_gradient if wanted[0] else None]
    end, columns = 0, 0 if blocks else inputs[0].shape[1] * wanted[0]
    for (dims, octaves, width), need in zip(blocks, wanted, strict=False):
        results.append(torch.empty(count, dims) if need else None)
        arguments += [results[-1] if need else none, end, dims, octaves]
        end += width
        columns = end if need else columns
    start, of_layers = 0, []
    for number, (weight, x) in enumerate(zip(weights, inputs, strict=True)):
        high = round_up(len(weight), 16)
        back = weight if number else weight[:, :columns]
        of_layers.append((start, start + high * x.shape[1], high, x.shape[1]))
        arguments += [pack(back.t(), high, dtype) if back.shape[1] else none, x, start]
        start += high * (x.shape[1] + 1)
    sums = workspace("perceptron", TASKS, start)
    first = kernels.BackwardArguments(
        rows=count,
        blocks=len(blocks),
        layers=len(weights),
        encoded=inputs[0],
        gradient=gradient,
        columns=columns,
        zeros=torch.zeros(round_up(columns, 16)),
        sums=sums,
        encoded_gradient=encoded_gradient,
    )
    launch(_KERNELS[dtype][1], TASKS, *first, *arguments)
    found = reduce_sum(sums)
    flat: list[Tensor] = []
    for weight, (begin, middle, high, width) in zip(weights, of_layers, strict=True):
        of_weight = found[begin:middle].view(high, width)
        flat += [of_weight[: len(weight), : weight.shape[1]], found[middle : middle + len(weight)]]
    return results, flat


class _Perceptron(Function):
    @staticmethod
    def forward(
        ctx: Any, dtype: torch.dtype, blocks: list[Block], count: int, *tensors: Tensor | None
    ) -> Tensor:
        flat, none = tensors[len(blocks) :], torch.empty(0, dtype=torch.int64)
        ctx.count = len(blocks)
        if _as_it_is(blocks, dtype):
            encoded, blocks = blocks[0].x.detach().contiguous(), []
        else:
            encoded = torch.empty(padded_rows(count), _encoded_width(blocks), dtype=dtype)
        arguments: list[Any] = []
        for block in blocks:
            rows = none if block.rows is None else block.rows.contiguous()
            arguments += [_whole_vectors(block.x), rows, block.x.shape[1], block.octaves]
        inputs, weights = [encoded], []
        for number in range(len(flat) // 2):
            weight, bias = flat[2 * number : 2 * number + 2]
            assert weight is not None
            weights.append(weight.detach())
            columns = round_up(len(weight), 16)
            added = torch.zeros(columns)
            if bias is not None:
                added[: len(bias)] = bias.detach()
            output = encoded
            if 2 * number + 2 < len(flat):
                output = torch.empty(padded_rows(count), columns, dtype=dtype)
                inputs.append(output)
            arguments += [pack(weight, inputs[number].shape[1], dtype), added, output]
        out = torch.empty(padded_rows(count), round_up(len(weights[-1]), 16))
        first = kernels.ForwardArguments(
            rows=count, blocks=len(blocks), layers=len(weights), encoded=encoded, out=out
        )
        launch(_KERNELS[dtype][0], -(-count // ROWS), *first, *arguments)
        ctx.inputs, ctx.weights = inputs, weights
        ctx.blocks = [(b.x.shape[1], b.octaves, b.width) for b in blocks]
        return out[:count, : len(weights[-1])].contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        wanted, needed = ctx.needs_input_grad[3 : 3 + ctx.count], ctx.needs_input_grad[3 + ctx.count :]
        results, flat = gradients(ctx.inputs, ctx.weights, ctx.blocks, wanted, gradient.contiguous())
        kept = (g if need else None for g, need in zip(flat, needed, strict=True))
        return (None, None, None, *results, *kept)


@encoded_mlp.register_cpu(suits=_suits)
def _encoded_mlp(blocks: Sequence[Any], layers: Sequence[Any], *, precision: Precision = "auto") -> Tensor:
    given, dtype = [Block(*block) for block in blocks], product_dtype(precision)
    count = len(given[0].x if given[0].rows is None else given[0].rows)
    flat = [tensor for layer in layers for tensor in layer]
    out: Tensor = _Perceptron.apply(dtype, given, count, *(block.x for block in given), *flat)  # type: ignore[no-untyped-call]
    return out


@product_dtype.register_cpu()
def _product_dtype(precision: Precision) -> torch.dtype:
    rounds = precision == "bfloat16" or (precision == "auto" and has("avx512bf16"))
    return torch.bfloat16 if rounds else torch.float32
