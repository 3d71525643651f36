"""Products of a perceptron in chunks of few sizes.

oneDNN prepares each product for its shape: it takes milliseconds and megabytes, and a march finds another number of
samples in every iteration. So rows are padded to a multiple of `CHUNK_TAIL` and multiplied in chunks of `CHUNK`, of
which only the last is smaller. Chunks also stay in the cache from one layer to the next.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops.cpu.jit.bfloat16 import load_low, store_low
from gridreg.ops.cpu.jit.compiler import float32, inline, kernel, matrix, next_task, uint16
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, one, store, wide
from gridreg.ops.cpu.jit.simd_math import gate
from gridreg.ops.cpu.mlp import dots

__all__ = ["CHUNK", "CHUNK_TAIL", "Chain", "chain_backward", "chain_forward", "padded_rows", "product"]

CHUNK = 4096
CHUNK_TAIL = 512
# Rows of one task, and of one entry of the sums over rows.
_ROWS = 128


def padded_rows(count: int) -> int:
    """``count`` rounded up to what is multiplied."""
    return -(-count // CHUNK_TAIL) * CHUNK_TAIL


def chunks(rows: int) -> Iterator[slice]:
    """Parts of at most `CHUNK` rows."""
    for start in range(0, rows, CHUNK):
        yield slice(start, min(start + CHUNK, rows))


def _part(x: Tensor, part: slice) -> Tensor:
    """Some rows, with zeros behind them up to a size that is multiplied."""
    missing = padded_rows(part.stop - part.start) - (part.stop - part.start)
    return F.pad(x[part], (0, 0, 0, missing)) if missing else x[part]


def _onednn_takes(dtype: torch.dtype) -> bool:
    if not torch._C._has_mkldnn:
        return False
    return dtype == torch.float32 or bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())


def product(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    """``x weight^T + bias``, then ReLU if wanted.

    By oneDNN if it can be had: MKL takes twice as long for results whose rows are not a multiple of 16 wide. In
    bfloat16 oneDNN refuses processors without AVX-512, where torch's own product serves.
    """
    fused = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    if fused is not None and _onednn_takes(x.dtype) and x.numel() and weight.numel():
        found: Tensor = fused(x, weight, bias, "relu" if relu else "none", [], "")
        return found
    found = F.linear(x, weight, bias)
    return found.relu_() if relu else found


@inline
def _gate_step(slope: Any, hidden: Any, sums: Any, i: Any, zero: Any) -> None:
    passed = gate(load_low(slope, i, zero), load_low(hidden, i, zero))
    store_low(slope, i, passed)
    store(sums, i, load(sums, i, zero) + passed)


@kernel
def _gate(table: Any) -> None:
    """Gradient and value ``(M, C)`` of a ReLU's output in bfloat16, sums ``(tasks, C)``: gate, and sum over rows."""
    slope, hidden, sums = matrix(table, 0, uint16), matrix(table, 1, uint16), matrix(table, 2, float32)
    width = slope.shape[1]
    split = width - width % LANES
    while True:
        task = next_task(table)
        if task < 0:
            break
        total = sums[task]
        for i in range(width):
            total[i] = float32(0)
        for n in range(task * _ROWS, min((task + 1) * _ROWS, slope.shape[0])):
            row, value = slope[n], hidden[n]
            for i in range(0, split, LANES):
                _gate_step(row, value, total, i, wide())
            for i in range(split, width):
                _gate_step(row, value, total, i, one())


@dataclass(frozen=True)
class Chain:
    """What a backward pass needs.

    Args:
        x: ``(N, in)`` input.
        weights: of each layer, in the input's precision.
        hidden: of each layer but the last, its output by chunk, padded.
        by_dots: whether `gridreg.ops.cpu.mlp.dots` multiplies; then there is one chunk.
    """

    x: Tensor
    weights: list[Tensor]
    hidden: list[list[Tensor]]
    by_dots: bool = False

    @property
    def rows(self) -> int:
        """N."""
        return int(self.x.shape[0])


def _gated(slope: Tensor, hidden: Tensor) -> tuple[Tensor, Tensor]:
    """The gradient before a ReLU, from that behind it and from its output; and its sum over rows."""
    if slope.dtype == torch.bfloat16:
        slope = slope.contiguous()
        tasks = -(-slope.shape[0] // _ROWS)
        sums = torch.empty(tasks, slope.shape[1])
        launch(_gate, tasks, slope, hidden, sums)
        return slope, sums.sum(0)
    # ReLU's output is 0 exactly where its gradient is.
    slope = torch.ops.aten.threshold_backward(slope, hidden, 0)
    return slope, slope.sum(0)


def chain_forward(
    x: Tensor,
    layers: Sequence[tuple[Tensor, Tensor | None]],
    offset: Tensor | None = None,
    rows: Tensor | None = None,
) -> tuple[Tensor, Chain]:
    """Linear layers with ReLU between them.

    Args:
        x: ``(N, in)``; its precision is that of the products.
        layers: float32 weights ``(out, in)`` and biases.
        offset: added to the first layer's output: ``(N, out)``, or ``(R, out)`` with ``rows (N,)``.

    Returns:
        ``(N, out)`` float32 and what the backward pass needs.
    """
    widest = max(x.shape[1], *(weight.shape[0] for weight, _ in layers))
    if x.dtype == torch.bfloat16 and offset is None and widest <= dots.WIDEST and dots.available():
        return _dots_forward(x, layers)
    weights = [weight.to(x.dtype).contiguous() for weight, _ in layers]
    biases = [None if bias is None else bias.to(x.dtype) for _, bias in layers]
    hidden: list[list[Tensor]] = [[] for _ in layers[1:]]
    out = torch.empty(x.shape[0], weights[-1].shape[0])
    for part in chunks(x.shape[0]):
        count = part.stop - part.start
        value = _part(x, part)
        for place, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            relu = place + 1 < len(weights)
            if place == 0 and offset is not None:
                value = product(value, weight, bias, False)
                value[:count] += offset[part] if rows is None else offset.index_select(0, rows[part])
                value = value.relu_() if relu else value
            else:
                value = product(value, weight, bias, relu)
            if relu:
                hidden[place].append(value)
        out[part] = value[:count]
    return out, Chain(x, weights, hidden)


def _dots_forward(x: Tensor, layers: Sequence[tuple[Tensor, Tensor | None]]) -> tuple[Tensor, Chain]:
    """`chain_forward` by `gridreg.ops.cpu.mlp.dots`."""
    hidden: list[list[Tensor]] = []
    value = x
    for weight, bias in layers[:-1]:
        found = dots.multiply(value, dots.pack(weight), bias=bias, relu=True)
        hidden.append([found])
        value = _cut(found, x.shape[0], weight.shape[0])
    weight, bias = layers[-1]
    out = dots.multiply(value, dots.pack(weight), bias=bias, dtype=torch.float32)
    return _cut(out, x.shape[0], weight.shape[0]), Chain(x, [w for w, _ in layers], hidden, by_dots=True)


def _cut(x: Tensor, rows: int, columns: int) -> Tensor:
    """The first rows and columns, contiguous."""
    return x[:rows, :columns].contiguous()


def _dots_backward(
    saved: Chain, gradient: Tensor, columns: int
) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """`chain_backward` by `gridreg.ops.cpu.mlp.dots`."""
    slope, of_layers = gradient.to(torch.bfloat16).contiguous(), []
    for place in reversed(range(len(saved.weights))):
        weight = saved.weights[place]
        if place == 0:
            of_layers.append(dots.weight_gradient(slope, saved.x))
            break
        (hidden,) = saved.hidden[place - 1]
        of_layers.append(dots.weight_gradient(slope, _cut(hidden, saved.rows, weight.shape[1])))
        found = dots.multiply(slope, dots.pack(weight.detach().t()), gates=hidden)
        slope = _cut(found, saved.rows, weight.shape[1])
    of_x = torch.empty(saved.rows, 0, dtype=torch.bfloat16)
    if columns:
        of_x = dots.multiply(slope, dots.pack(saved.weights[0].detach().t()[:columns]))
    return of_x, of_layers[::-1]


def chain_backward(
    saved: Chain, gradient: Tensor, columns: int, of_first: list[Tensor] | None = None
) -> tuple[Tensor, list[tuple[Tensor, Tensor]]]:
    """Gradients of `chain_forward`.

    Args:
        saved: what it returned.
        gradient: ``(N, out)`` float32.
        columns: how many columns of the input's gradient are wanted, from the first on.
        of_first: if given, the gradient of the first layer's output is appended, by chunk.

    Returns:
        Gradients of the input, ``(N, columns)`` in its precision, perhaps with more rows and columns, and of each
        layer's weight and bias, float32.
    """
    if saved.by_dots:
        return _dots_backward(saved, gradient, columns)
    depth, dtype = len(saved.weights), saved.x.dtype
    of_weights = [torch.zeros(weight.shape) for weight in saved.weights]
    of_biases = [torch.zeros(weight.shape[0]) for weight in saved.weights]
    of_x = torch.empty(saved.rows, columns, dtype=dtype)
    # Transposed once: oneDNN is slow by orders of magnitude on some weights that are views.
    back = [weight.t().contiguous() for weight in saved.weights]
    back[0] = back[0][:columns]
    for number, part in enumerate(chunks(saved.rows)):
        count = part.stop - part.start
        slope = _part(gradient, part).to(dtype)
        of_biases[-1] += gradient[part].sum(0)
        for place in reversed(range(depth)):
            read = _part(saved.x, part) if place == 0 else saved.hidden[place - 1][number]
            of_weights[place] += slope.t() @ read
            if place > 0:
                slope, total = _gated(product(slope, back[place], None, False), read)
                of_biases[place - 1] += total
        if of_first is not None:
            of_first.append(slope[:count])
        if columns:
            of_x[part] = product(slope, back[0], None, False)[:count]
    return of_x, list(zip(of_weights, of_biases, strict=True))
