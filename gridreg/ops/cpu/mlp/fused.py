"""A perceptron on positional encodings, forward and backward in one kernel each.

Layer by layer a small network spends a third of its time between products. Here a task takes some rows through all
layers while they are in the nearest caches. Gradients of the weights are summed by a fixed number of tasks, so that
they do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.ops.cpu.jit.compiler import Kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES
from gridreg.ops.cpu.jit.workspace import workspace
from gridreg.ops.cpu.mlp import dots
from gridreg.ops.cpu.mlp import fused_bf16 as perceptron_dots
from gridreg.ops.cpu.mlp import fused_f32 as perceptron_float
from gridreg.ops.cpu.mlp import gemm_bf16 as dot_blocks
from gridreg.ops.cpu.mlp import gemm_f32 as fma_blocks
from gridreg.ops.cpu.mlp.gemm_tile import ROWS, TASKS, WIDEST
from gridreg.ops.cpu.reductions import reduce_sum

__all__ = ["Block", "fits", "gradients", "perceptron", "rows_of"]

# Of a block of results, the higher of both precisions.
_HIGH = max(dot_blocks.HIGH, fma_blocks.HIGH)


class Block(NamedTuple):
    """One of the inputs of `gridreg.ops.encoded_mlp`.

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


class _Kind(NamedTuple):
    """Kernels of a precision, and how they read a weight ``(out, in)`` whose input has so many columns in memory."""

    forward: Kernel
    backward: Kernel
    pack: Callable[[Tensor, int], Tensor]


_KINDS = {
    torch.bfloat16: _Kind(perceptron_dots.forward, perceptron_dots.backward, dots.pack),
    torch.float32: _Kind(
        perceptron_float.forward, perceptron_float.backward, lambda weight, width: fma_blocks.pack(weight)
    ),
}


def _up(count: int, to: int) -> int:
    return -(-count // to) * to


def rows_of(count: int) -> int:
    """Rows of what passes between layers: whole blocks, also from the first row of any task of the backward pass on."""
    return _up(count, _HIGH) + _HIGH


def _encoded_width(blocks: Sequence[Block]) -> int:
    """Columns of the encodings and zeros; the last vector that is written may reach beyond its block."""
    return _up(sum(block.width for block in blocks) + LANES - 1, 16)


def fits(blocks: Sequence[Block], layers: Sequence[Any], dtype: torch.dtype) -> bool:
    """Whether the processor and the sizes allow it in a precision."""
    widest = max(_encoded_width(blocks), *(_up(weight.shape[0], 16) for weight, _ in layers))
    return widest <= WIDEST and (dtype == torch.float32 or dot_blocks.available())


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
        inputs: of each layer, as the forward pass left them; their precision is that of the products.
        weights: of each layer.
        blocks: dims, octaves and columns of each.
        wanted: whether it has a gradient.
        gradient: ``(N, out)``.
    """
    count, none, kind = len(gradient), torch.empty(0), _KINDS[inputs[0].dtype]
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
        arguments += [kind.pack(back.t(), high) if back.shape[1] else none, x, place]
        place += high * (x.shape[1] + 1)
    sums = workspace("perceptron", TASKS, place)
    launch(
        kind.backward, TASKS, count, len(blocks), len(weights), inputs[0], gradient, columns,
        torch.zeros(_up(columns, 16)), sums, *arguments,
    )  # fmt: skip
    found = reduce_sum(sums)
    flat: list[Tensor] = []
    for weight, (begin, middle, high, width) in zip(weights, places, strict=True):
        of_weight = found[begin:middle].view(high, width)
        flat += [of_weight[: weight.shape[0], : weight.shape[1]], found[middle : middle + len(weight)]]
    return results, flat


class _Perceptron(Function):
    @staticmethod
    def forward(
        ctx: Any, dtype: torch.dtype, blocks: list[Block], count: int, *tensors: Tensor | None
    ) -> Tensor:
        flat, kind = tensors[len(blocks) :], _KINDS[dtype]
        width, none = _encoded_width(blocks), torch.empty(0, dtype=torch.int64)
        encoded = torch.empty(rows_of(count), width, dtype=dtype)
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
                output = torch.empty(len(encoded), high, dtype=dtype)
                inputs.append(output)
            arguments += [kind.pack(weight, inputs[place // 2].shape[1]), more, output]
        out = torch.empty(len(encoded), _up(weights[-1].shape[0], 16))
        tasks = -(-count // ROWS)
        launch(kind.forward, tasks, count, len(blocks), len(weights), encoded, out, *arguments)
        ctx.inputs, ctx.weights = inputs, weights
        ctx.blocks = [(b.x.shape[1], b.octaves, b.width) for b in blocks]
        return out[:count, : weights[-1].shape[0]].contiguous()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[3 : 3 + len(ctx.blocks)]
        needed = ctx.needs_input_grad[3 + len(ctx.blocks) :]
        results, flat = gradients(ctx.inputs, ctx.weights, ctx.blocks, wanted, gradient.contiguous())
        return (
            None,
            None,
            None,
            *results,
            *(g if need else None for g, need in zip(flat, needed, strict=True)),
        )


def perceptron(blocks: list[Block], count: int, flat: Sequence[Tensor | None], dtype: torch.dtype) -> Tensor:
    """See `gridreg.ops.encoded_mlp`; blocks and layers that `fits` allows, float32 on the CPU.

    Args:
        blocks: inputs; what has rows has no gradient.
        count: N, not 0.
        flat: weight and bias of each layer, one behind the other.
        dtype: of the products, bfloat16 or float32.
    """
    out: Tensor = _Perceptron.apply(dtype, blocks, count, *(block.x for block in blocks), *flat)  # type: ignore[no-untyped-call]
    return out
