"""Compiled compositing along rays: weights, pixels and early termination, with their gradients."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.ops import composite as ops
from gridreg.ops.cpu.jit.compiler import kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.table import Matrix, Vector, float32, int64, uint8

# Rays of one task.
_RAYS = 64


def _tasks(offsets: Tensor) -> int:
    return -(-(offsets.numel() - 1) // _RAYS)


@kernel
def _weights_forward(
    task: int, offsets: Vector[int64], alpha: Vector[float32], through: Vector[float32],
    weights: Vector[float32], after: Vector[float32],
) -> None:  # fmt: skip
    """``w_n = T_n alpha_n`` and ``T_{n+1}``, from ``alpha`` and ``exp(-tau)``."""
    rays, samples = offsets.shape[0] - 1, alpha.shape[0]
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
        transmittance = float32(1)
        for n in range(max(offsets[ray], 0), min(offsets[ray + 1], samples)):
            weights[n] = transmittance * alpha[n]
            transmittance *= through[n]
            after[n] = transmittance


@kernel
def _weights_backward(
    task: int, offsets: Vector[int64], weights: Vector[float32], after: Vector[float32],
    gradient: Vector[float32], result: Vector[float32],
) -> None:  # fmt: skip
    """``dL/dtau_n = g_n T_{n+1} - sum_{m > n} g_m w_m``."""
    rays, samples = offsets.shape[0] - 1, weights.shape[0]
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
        behind = 0.0
        first, end = max(offsets[ray], 0), min(offsets[ray + 1], samples)
        for back in range(end - first):
            n = end - 1 - back
            result[n] = float32(gradient[n] * after[n] - behind)
            behind += gradient[n] * weights[n]


class _Weights(Function):
    @staticmethod
    def forward(ctx: Any, optical_depth: Tensor, offsets: Tensor) -> Tensor:
        negative = optical_depth.neg().contiguous()
        alpha = torch.expm1(negative).neg_()
        weights, after = torch.empty_like(alpha), torch.empty_like(alpha)
        launch(_weights_forward, _tasks(offsets), offsets, alpha, negative.exp_(), weights, after)
        ctx.save_for_backward(offsets, weights, after)
        return weights

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        offsets, weights, after = ctx.saved_tensors
        result = torch.empty_like(weights)
        launch(_weights_backward, _tasks(offsets), offsets, weights, after, gradient.contiguous(), result)
        return result, None


@kernel
def _pixels_forward(
    task: int, offsets: Vector[int64], weights: Vector[float32], colours: Matrix[float32], t: Vector[float32],
    background: Matrix[float32], out: Matrix[float32], opacity: Vector[float32], depth: Vector[float32],
) -> None:  # fmt: skip
    """Offsets, weights, colours, distances, background; colour, opacity and depth of every ray."""
    rays, samples = offsets.shape[0] - 1, weights.shape[0]
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
        red, green, blue = float32(0), float32(0), float32(0)
        sum_, far = float32(0), float32(0)
        for n in range(max(offsets[ray], 0), min(offsets[ray + 1], samples)):
            weight = weights[n]
            red += weight * colours[n, 0]
            green += weight * colours[n, 1]
            blue += weight * colours[n, 2]
            sum_ += weight
            far += weight * t[n]
        rest = float32(1) - sum_
        out[ray, 0] = red + rest * background[ray, 0]
        out[ray, 1] = green + rest * background[ray, 1]
        out[ray, 2] = blue + rest * background[ray, 2]
        opacity[ray], depth[ray] = sum_, far


@kernel
def _pixels_backward(
    task: int, offsets: Vector[int64], weights: Vector[float32], colours: Matrix[float32], t: Vector[float32],
    background: Matrix[float32], g: Matrix[float32], of_opacity: Vector[float32], of_depth: Vector[float32],
    of_weights: Vector[float32], of_colours: Matrix[float32],
) -> None:  # fmt: skip
    """Arguments as of `_pixels_forward`, with gradients for the results; gradients of weights and colours."""
    rays, samples = offsets.shape[0] - 1, weights.shape[0]
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
        red, green, blue = g[ray, 0], g[ray, 1], g[ray, 2]
        hidden = red * background[ray, 0] + green * background[ray, 1] + blue * background[ray, 2]
        base, slope = of_opacity[ray] - hidden, of_depth[ray]
        for n in range(max(offsets[ray], 0), min(offsets[ray + 1], samples)):
            weight = weights[n]
            seen = red * colours[n, 0] + green * colours[n, 1] + blue * colours[n, 2]
            of_weights[n] = seen + base + slope * t[n]
            of_colours[n, 0] = weight * red
            of_colours[n, 1] = weight * green
            of_colours[n, 2] = weight * blue


class _Pixels(Function):
    @staticmethod
    def forward(
        ctx: Any, weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        given = tuple(x.contiguous() for x in (offsets, weights, colours, t, background))
        rays = offsets.numel() - 1
        out = torch.empty(rays, 3), torch.empty(rays), torch.empty(rays)
        launch(_pixels_forward, _tasks(offsets), *given, *out)
        ctx.save_for_backward(*given)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradient: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.saved_tensors
        of_weights, of_colours = torch.empty_like(given[1]), torch.empty_like(given[2])
        slopes = (x.contiguous() for x in gradient)
        launch(_pixels_backward, _tasks(given[0]), *given, *slopes, of_weights, of_colours)
        return of_weights, of_colours, None, None, None


@kernel
def _seen(
    task: int, offsets: Vector[int64], through: Vector[float32], bound: float32, mask: Vector[uint8],
) -> None:  # fmt: skip
    """Whether the transmittance before each sample is at least a bound."""
    rays, samples = offsets.shape[0] - 1, through.shape[0]
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
        transmittance = float32(1)
        for n in range(max(offsets[ray], 0), min(offsets[ray + 1], samples)):
            mask[n] = transmittance >= bound
            transmittance *= through[n]


@ops.composite_weights.register_cpu()
def composite_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """See `gridreg.ops.composite_weights`."""
    return _Weights.apply(optical_depth, offsets.contiguous())  # type: ignore[no-any-return, no-untyped-call]


@ops.pixels.register_cpu(suits=ops.pixels_suit_cpu)
def pixels(
    weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `gridreg.ops.pixels`."""
    return _Pixels.apply(weights, colours, t, background, offsets)  # type: ignore[no-any-return, no-untyped-call]


@ops.terminate.register_cpu()
@torch.no_grad()
def terminate(optical_depth: Tensor, offsets: Tensor, bound: float) -> Tensor:
    """See `gridreg.ops.terminate`."""
    mask = torch.empty(optical_depth.shape, dtype=torch.uint8)
    through = optical_depth.neg().contiguous().exp_()
    launch(_seen, _tasks(offsets), offsets.contiguous(), through, float(bound), mask)
    return mask.view(torch.bool)
