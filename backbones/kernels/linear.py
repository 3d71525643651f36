"""Multi-layer perceptrons on the CPU through oneDNN: fused ReLU, and bfloat16 where the processor multiplies
it.

Weights stay float32. In bfloat16 inputs, weights and intermediate results are rounded to 8 bits, products are
summed in float32: a value is off by at most 2^-7 of the largest. Gradients are off by 4 % in norm at random
weights, most of that from units at the edge of their ReLU, without bias.
"""

from __future__ import annotations

import platform
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable
from torch.nn import functional as F

from gridreg.errors import InputError
from gridreg.rendering.backends import takes_compiled

__all__ = ["Layer", "Precision", "bfloat16_is_fast", "mlp"]

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


def _product(x: Tensor, weight: Tensor, bias: Tensor | None, relu: bool) -> Tensor:
    """``x weight^T + bias``, then ReLU if wanted.

    By oneDNN if it can be had: MKL takes twice as long for results whose rows are not a multiple of 16 wide.
    """
    fused = getattr(torch.ops.mkldnn, "_linear_pointwise", None)
    if fused is not None and torch._C._has_mkldnn and x.numel() and weight.numel():
        found: Tensor = fused(x, weight, bias, "relu" if relu else "none", [], "")
        return found
    found = F.linear(x, weight, bias)
    return found.relu_() if relu else found


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
        layers = [(flat[i], flat[i + 1]) for i in range(0, len(flat), 2)]
        inputs, weights = [], []
        hidden = x.to(dtype).contiguous()
        for place, (weight, bias) in enumerate(layers):
            assert weight is not None
            relu = place + 1 < len(layers)
            low = weight.to(dtype).contiguous()
            low_bias = None if bias is None else bias.to(dtype)
            inputs.append(hidden)
            weights.append(low)
            if place == 0 and offset is not None:
                hidden = _product(hidden, low, low_bias, False)
                share = offset.to(dtype)
                hidden += share if rows is None else share.index_select(0, rows)
                hidden = hidden.relu_() if relu else hidden
            else:
                hidden = _product(hidden, low, low_bias, relu)
        ctx.save_for_backward(rows, *inputs, *weights)
        ctx.dtype, ctx.depth = dtype, len(layers)
        ctx.offsets = 0 if offset is None else offset.shape[0]
        return hidden.to(x.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        rows, *saved = ctx.saved_tensors
        inputs, weights = saved[: ctx.depth], saved[ctx.depth :]
        wanted = ctx.needs_input_grad
        of_layers: list[Tensor | None] = []
        of_offset: Tensor | None = None
        of_x: Tensor | None = None
        slope = gradient.to(ctx.dtype).contiguous()
        for place in reversed(range(ctx.depth)):
            if place + 1 < ctx.depth:
                # ReLU's output is 0 exactly where its gradient is.
                slope = torch.ops.aten.threshold_backward(slope, inputs[place + 1], 0)
            of_weight = (slope.t() @ inputs[place]).float() if wanted[4 + 2 * place] else None
            of_bias = slope.sum(0, dtype=torch.float32) if wanted[5 + 2 * place] else None
            of_layers = [of_weight, of_bias, *of_layers]
            if place > 0:
                slope = _product(slope, weights[place].t(), None, False)
        if wanted[2]:
            of_offset = slope.float()
            if rows is not None:
                of_offset = torch.zeros(ctx.offsets, slope.shape[1]).index_add_(0, rows, of_offset)
        if wanted[3]:
            of_x = _product(slope, weights[0].t(), None, False).float()
        return (None, None, of_offset, of_x, *of_layers)


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
        x: ``(N, in)``.
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
    if precision not in _PRECISIONS:
        raise InputError(f"precision: found {precision!r}, expected one of {', '.join(_PRECISIONS)}")
    if not layers:
        raise InputError("layers: found none, expected at least one")
    width = x.shape[-1]
    for place, (weight, bias) in enumerate(layers):
        if x.dim() != 2 or weight.dim() != 2 or weight.shape[1] != width:
            found = tuple(weight.shape)
            raise InputError(
                f"layers[{place}]: found a weight {found}, expected (out, {width}) for x {tuple(x.shape)}"
            )
        width = weight.shape[0]
        if bias is not None and tuple(bias.shape) != (width,):
            raise InputError(f"layers[{place}]: found a bias {tuple(bias.shape)}, expected ({width},)")
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
    if takes_compiled(*given):
        low = precision == "bfloat16" or (precision == "auto" and bfloat16_is_fast())
        dtype = torch.bfloat16 if low else torch.float32
        result: Tensor = _MLP.apply(dtype, rows, offset, x, *flat)  # type: ignore[no-untyped-call]
        return result
    hidden = x
    for place, (weight, bias) in enumerate(layers):
        hidden = F.linear(hidden, weight, bias)
        if place == 0 and offset is not None:
            hidden = hidden + (offset if rows is None else offset.index_select(0, rows))
        if place + 1 < len(layers):
            hidden = torch.relu(hidden)
    return hidden
