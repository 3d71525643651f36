"""Fused positional encoding: one sine and one cosine per input, all octaves from them, one pass backward."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.encodings import Order, positional_encoding
from gridreg.errors import InputError
from gridreg.ops.cpu.jit.compiler import float32, inline, integer, kernel, matrix, next_task, real
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, wide
from gridreg.ops.dispatch import takes_compiled

__all__ = ["MOST_OCTAVES", "encode", "encode_together"]

# Rows of one task.
_ROWS = 256
# Beyond, the doubling of angles has cost more than two digits of float32.
MOST_OCTAVES = 8


@inline
def _forward_step(
    x: Any, s: Any, c: Any, out: Any, i: int, at: int, dims: int, octaves: int, like: Any
) -> None:
    """Write all octaves of elements ``i`` on; ``sin 2a = 2 sin a cos a``, ``cos 2a = 1 - 2 sin^2 a``."""
    sine, cosine = load(s, i, like), load(c, i, like)
    store(out, at + i, load(x, i, like))
    for octave in range(octaves):
        place = at + i + (1 + 2 * octave) * dims
        store(out, place, sine)
        store(out, place + dims, cosine)
        doubled = float32(2) * sine
        sine, cosine = doubled * cosine, float32(1) - doubled * sine


@kernel
def _forward(table: Any) -> None:
    """x, sin, cos ``(N, D)``, out ``(N, W)``, first column, octaves."""
    x, s, c, out = (
        matrix(table, 0, float32),
        matrix(table, 1, float32),
        matrix(table, 2, float32),
        matrix(table, 3, float32),
    )
    at, octaves = integer(table, 4), integer(table, 5)
    dims = x.shape[1]
    split = dims - dims % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _ROWS, min((task + 1) * _ROWS, x.shape[0])):
            xs, ss, cs, row = x[n], s[n], c[n], out[n]
            for i in range(0, split, LANES):
                _forward_step(xs, ss, cs, row, i, at, dims, octaves, wide())
            for i in range(split, dims):
                _forward_step(xs, ss, cs, row, i, at, dims, octaves, one())


@inline
def _backward_step(
    out: Any, g: Any, result: Any, i: int, at: int, dims: int, octaves: int, scale: Any, like: Any
) -> None:
    """``g_x + sum over octaves of f (cos g_sin - sin g_cos)``."""
    total = load(g, at + i, like)
    frequency = scale
    for octave in range(octaves):
        place = at + i + (1 + 2 * octave) * dims
        sine, cosine = load(out, place, like), load(out, place + dims, like)
        total = total + frequency * (cosine * load(g, place, like) - sine * load(g, place + dims, like))
        frequency = frequency * float32(2)
    store(result, i, total)


@kernel
def _backward(table: Any) -> None:
    """out, its gradient ``(N, W)``, result ``(N, D)``, first column, octaves, scale."""
    out, g, result = matrix(table, 0, float32), matrix(table, 1, float32), matrix(table, 2, float32)
    at, octaves, scale = integer(table, 3), integer(table, 4), real(table, 5)
    dims = result.shape[1]
    split = dims - dims % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _ROWS, min((task + 1) * _ROWS, out.shape[0])):
            row, slope, into = out[n], g[n], result[n]
            for i in range(0, split, LANES):
                _backward_step(row, slope, into, i, at, dims, octaves, scale, wide())
            for i in range(split, dims):
                _backward_step(row, slope, into, i, at, dims, octaves, scale, one())


class _Encode(Function):
    """Blocks side by side, each in the order "octave" with its input first."""

    @staticmethod
    def forward(ctx: Any, octaves: tuple[int, ...], scale: float, *blocks: Tensor) -> Tensor:
        rows = blocks[0].shape[0]
        columns = [0]
        for x, count in zip(blocks, octaves, strict=True):
            columns.append(columns[-1] + x.shape[1] * (1 + 2 * count))
        out = torch.empty(rows, columns[-1])
        for x, count, at in zip(blocks, octaves, columns, strict=False):
            x = x.contiguous()
            angle = x * scale if count else x
            sine, cosine = (angle.sin(), angle.cos()) if count else (x, x)
            launch(_forward, -(-rows // _ROWS), x, sine, cosine, out, at, count)
        ctx.save_for_backward(out)
        ctx.octaves, ctx.scale, ctx.columns, ctx.sizes = octaves, scale, columns, [x.shape[1] for x in blocks]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        (out,) = ctx.saved_tensors
        gradient = gradient.contiguous()
        results: list[Tensor | None] = [None, None]
        for wanted, size, count, at in zip(
            ctx.needs_input_grad[2:], ctx.sizes, ctx.octaves, ctx.columns, strict=False
        ):
            result = torch.empty(out.shape[0], size) if wanted else None
            if result is not None:
                launch(
                    _backward, -(-out.shape[0] // _ROWS), out, gradient, result, at, count, float(ctx.scale)
                )
            results.append(result)
        return tuple(results)


def encode_together(blocks: Sequence[tuple[Tensor, int]], scale: float = 1.0) -> Tensor:
    """Positional encodings of several inputs, side by side: what an MLP reads, written once.

    On CPU float32 tensors the sine and cosine of the first octave give those of the others by doubling the
    angle, and the backward pass reads them from the output (error at most ``2^octaves`` roundings); otherwise
    `positional_encoding`.

    Args:
        blocks: pairs of ``(N, D)`` and a number of octaves.
        scale: factor of all frequencies.

    Returns:
        ``(N, W)``, ``W`` the sum of ``D * (1 + 2 * octaves)``; each block in the order "octave", its input
        first.

    Raises:
        InputError: no blocks, or shapes do not fit, or octaves is negative.

    Example:
        >>> encode_together([(torch.zeros(1, 1), 1), (torch.ones(1, 2), 0)])
        tensor([[0., 0., 1., 1., 1.]])
    """
    if not blocks:
        raise InputError("blocks: found none, expected at least one")
    rows = blocks[0][0].shape[0]
    for x, octaves in blocks:
        if x.dim() != 2 or x.shape[0] != rows:
            raise InputError(f"blocks: found shape {tuple(x.shape)}, expected ({rows}, D)")
        if octaves < 0:
            raise InputError(f"octaves: found {octaves}, expected a number from 0 on")
    counts = tuple(octaves for _, octaves in blocks)
    if takes_compiled(*(x for x, _ in blocks)) and max(counts) <= MOST_OCTAVES:
        found: Tensor = _Encode.apply(counts, scale, *(x for x, _ in blocks))  # type: ignore[no-untyped-call]
        return found
    return torch.cat([positional_encoding(x, octaves, scale=scale) for x, octaves in blocks], dim=-1)


def encode(x: Tensor, octaves: int, order: Order = "octave", scale: float = 1.0) -> Tensor:
    """`gridreg.encodings.positional_encoding` of ``(N, D)`` with its input first; fused on the CPU.

    Args:
        x: ``(N, D)``.
        octaves: number of octaves.
        order: of the channels; others than "octave" cost one more pass.
        scale: factor of all frequencies.

    Returns:
        ``(N, D * (1 + 2 * octaves))``.

    Raises:
        InputError: the order is unknown, the shape does not fit, or octaves is negative.

    Example:
        >>> encode(torch.tensor([[0.5, 0.0]]), 1).shape
        torch.Size([1, 6])
    """
    if order == "octave":
        return encode_together([(x, octaves)], scale)
    if order not in ("sines_first", "coordinate") or not takes_compiled(x):
        return positional_encoding(x, octaves, order, scale=scale)
    found = encode_together([(x, octaves)], scale)
    # (N, K, sine or cosine, D): the other orders are permutations of it.
    waves = found[:, x.shape[1] :].reshape(x.shape[0], octaves, 2, x.shape[1])
    waves = waves.transpose(1, 2) if order == "sines_first" else waves.permute(0, 2, 3, 1)
    return torch.cat([x, waves.flatten(1)], dim=-1)
