"""Multi-layer perceptrons on the CPU through oneDNN: fused ReLU, and bfloat16 where the processor multiplies
it.

Weights stay float32. In bfloat16 inputs, weights and intermediate results are rounded to 8 bits, products are
summed in float32: a value is off by at most 2^-7 of the largest. Gradients are off by 4 % in norm at random
weights, most of that from units at the edge of their ReLU, without bias.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias, cast

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gridreg.errors import InputError
from gridreg.ops.cpu.mlp.chain import chain_backward, chain_forward
from gridreg.ops.dispatch import takes_compiled

__all__ = [
    "Layer",
    "Precision",
    "bfloat16_is_fast",
    "check_layers",
    "check_precision",
    "mlp",
    "product_dtype",
]

Precision: TypeAlias = Literal["float32", "bfloat16", "auto"]
"""Of products: "auto" is bfloat16 where `bfloat16_is_fast`, float32 elsewhere."""

_PRECISIONS = ("float32", "bfloat16", "auto")


class Layer(NamedTuple):
    """Weight ``(out, in)`` and bias ``(out,)`` or None."""

    weight: Tensor
    bias: Tensor | None


def bfloat16_is_fast() -> bool:
    """Whether the processor multiplies bfloat16 itself, and torch's oneDNN makes use of it.

    oneDNN also claims support where it only emulates it.
    """
    try:
        supported = bool(torch.ops.mkldnn._is_mkldnn_bf16_supported())
    except (AttributeError, RuntimeError):
        return False
    if platform.machine().lower() in ("aarch64", "arm64"):
        return supported
    native = (
        getattr(torch.cpu, name, None) for name in ("_is_avx512_bf16_supported", "_is_amx_tile_supported")
    )
    return supported and any(check is not None and check() for check in native)


def check_precision(precision: str) -> None:
    """Raise `InputError` for an unknown one."""
    if precision not in _PRECISIONS:
        raise InputError(f"precision: found {precision!r}, expected one of {', '.join(_PRECISIONS)}")


def product_dtype(precision: Precision) -> torch.dtype:
    """Of products of float32 tensors on the CPU."""
    low = precision == "bfloat16" or (precision == "auto" and bfloat16_is_fast())
    return torch.bfloat16 if low else torch.float32


class _MLP(Function):
    @staticmethod
    def forward(
        ctx: Any,
        dtype: torch.dtype,
        rows: Tensor | None,
        offset: Tensor | None,
        x: Tensor,
        *flat: Tensor | None,
    ) -> Tensor:
        share = None if offset is None else offset.to(dtype)
        layers = [(cast(Tensor, flat[i]), flat[i + 1]) for i in range(0, len(flat), 2)]
        out, ctx.saved = chain_forward(x.to(dtype).contiguous(), layers, share, rows)
        ctx.rows, ctx.dtype = rows, x.dtype
        ctx.offsets = 0 if offset is None else offset.shape[0]
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad
        slopes: list[Tensor] | None = [] if wanted[2] else None
        of_x, of_layers = chain_backward(
            ctx.saved, gradient, ctx.saved.x.shape[1] if wanted[3] else 0, slopes
        )
        of_x = of_x[: ctx.saved.rows, : ctx.saved.x.shape[1]]
        of_offset: Tensor | None = None
        if slopes is not None:
            of_offset = torch.cat([torch.empty(0, ctx.saved.weights[0].shape[0]), *slopes]).float()
            if ctx.rows is not None:
                into = torch.zeros(ctx.offsets, of_offset.shape[1])
                of_offset = into.index_add_(0, ctx.rows, of_offset)
        flat = [tensor for pair in of_layers for tensor in pair]
        kept = (g if need else None for g, need in zip(flat, wanted[4:], strict=True))
        return (None, None, of_offset, of_x.to(ctx.dtype) if wanted[3] else None, *kept)


def check_layers(layers: Sequence[Layer | tuple[Tensor, Tensor | None]], width: int) -> int:
    """Width of what the last layer returns.

    Raises:
        InputError: if there are none, or shapes do not fit inputs of ``width``.
    """
    if not layers:
        raise InputError("layers: found none, expected at least one")
    for place, (weight, bias) in enumerate(layers):
        if weight.dim() != 2 or weight.shape[1] != width:
            raise InputError(
                f"layers[{place}]: found a weight {tuple(weight.shape)}, expected (out, {width})"
            )
        width = weight.shape[0]
        if bias is not None and tuple(bias.shape) != (width,):
            raise InputError(f"layers[{place}]: found a bias {tuple(bias.shape)}, expected ({width},)")
    return width


def mlp(
    x: Tensor,
    layers: Sequence[Layer | tuple[Tensor, Tensor | None]],
    *,
    offset: Tensor | None = None,
    rows: Tensor | None = None,
    precision: Precision = "auto",
) -> Tensor:
    """Linear layers with ReLU between them.

    Args:
        x: ``(N, in)``; may be bfloat16 where products are, and then its gradient is.
        layers: pairs of weight ``(out, in)`` and bias ``(out,)`` or None.
        offset: ``(N, out)`` of the first layer, added to it before its ReLU; or ``(R, out)`` with ``rows``:
            what depends on the ray alone, such as its direction, is computed once per ray.
        rows: ``(N,)`` int64, the row of ``offset`` for each row of ``x``.
        precision: of products on the CPU in float32; all other tensors are multiplied in their own precision.

    Returns:
        ``(N, out)`` of the last layer, without activation; differentiable once.

    Raises:
        InputError: for an unknown precision, no layers, or shapes that do not fit.

    Example:
        >>> layer = Layer(torch.tensor([[1.0], [-1.0]]), None), Layer(torch.ones(1, 2), torch.ones(1))
        >>> mlp(torch.tensor([[2.0], [-3.0]]), layer, precision="float32").tolist()
        [[3.0], [4.0]]
    """
    check_precision(precision)
    if x.dim() != 2:
        raise InputError(f"x: found shape {tuple(x.shape)}, expected (N, in)")
    check_layers(layers, x.shape[1])
    if offset is not None:
        expected = ("R" if rows is not None else x.shape[0], layers[0][0].shape[0])
        if (
            offset.dim() != 2
            or offset.shape[1] != expected[1]
            or (rows is None and offset.shape[0] != x.shape[0])
        ):
            raise InputError(f"offset: found {tuple(offset.shape)}, expected {expected}")
    if rows is not None and (offset is None or tuple(rows.shape) != x.shape[:1]):
        raise InputError(f"rows: found {tuple(rows.shape)}, expected ({x.shape[0]},) beside an offset")
    flat = [tensor for layer in layers for tensor in layer]
    given = [tensor for tensor in (x, offset, *flat) if tensor is not None]
    dtype = product_dtype(precision)
    low = x.dtype == torch.bfloat16 and dtype == torch.bfloat16
    # One product in float32 has nothing to fuse, and torch's own needs neither chunks nor copies.
    alone = len(layers) == 1 and dtype == torch.float32
    if takes_compiled(*given[low:]) and not alone:
        result: Tensor = _MLP.apply(dtype, rows, offset, x, *flat)  # type: ignore[no-untyped-call]
        return result
    hidden = x.to(layers[0][0].dtype)
    for place, (weight, bias) in enumerate(layers):
        hidden = F.linear(hidden, weight, bias)
        if place == 0 and offset is not None:
            hidden = hidden + (offset if rows is None else offset.index_select(0, rows))
        if place + 1 < len(layers):
            hidden = torch.relu(hidden)
    return hidden
