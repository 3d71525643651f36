"""Compiled lookups in VM and CP grids as differentiable functions."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor

from gridreg.ops import cp as cp_ops
from gridreg.ops import vm as vm_ops
from gridreg.ops.cpu import cp, vm, vm_gradient
from gridreg.ops.cpu.jit.simd import LANES
from gridreg.ops.cpu.march import mark
from gridreg.ops.cpu.march_density import march_density
from gridreg.ops.cpu.reductions import round_stochastically
from gridreg.ops.gradient_buffers import gradient_buffers, rounding_fraction
from gridreg.ops.interpolation import suits_cpu
from gridreg.ops.ray_marching import Activation, MarchArguments, RayMarchResult


class _Lookup(torch.autograd.Function):
    """A lookup with its compiled backward pass; grids are planes, if any, and three lines."""

    @staticmethod
    def forward(
        ctx: Any,
        forward: Callable[..., Tensor],
        backward: Callable[..., Any],
        u: Tensor,
        read: int,
        *grids: Tensor,
    ) -> Tensor:
        ctx.backward_pass, ctx.read = backward, read
        ctx.save_for_backward(u, *grids)
        return forward(u.detach().contiguous(), *_parts(grids), read)

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> tuple[Any, ...]:
        u, *grids = ctx.saved_tensors
        return (None, None, None, None, *_gradients(ctx, u, grids, upstream))


def _gradients(ctx: Any, u: Tensor, grids: Sequence[Tensor], upstream: Tensor) -> list[Tensor | None]:
    """Gradients of the grids, as a backward pass returns them."""
    buffers, returned = gradient_buffers(grids[:-3])
    given = [buffers] if buffers else []
    lines = ctx.backward_pass(
        u.detach().contiguous(), *_parts(grids), ctx.read, upstream.contiguous(), *given
    )
    return [*returned, *lines]


def _parts(grids: Sequence[Tensor]) -> list[list[Tensor]]:
    """Planes, if there are any, and lines, as kernels want them."""
    contiguous = [grid.detach().contiguous() for grid in grids]
    return [contiguous[:-3], contiguous[-3:]] if len(grids) > 3 else [contiguous]


def _opened(lines: Sequence[Tensor], open_channels: int | None) -> tuple[Sequence[Tensor], int]:
    """Lines without closed channels, and how many channels to read."""
    channels = lines[0].shape[1]
    if open_channels is None or open_channels >= channels:
        return lines, channels
    # Whole vectors are read: closed channels among them must count as 0, and their gradient stops here.
    lines = [torch.cat([x[:, :open_channels], torch.zeros_like(x[:, open_channels:])], 1) for x in lines]
    return lines, min(channels, -(-open_channels // LANES) * LANES)


class _Activated(torch.autograd.Function):
    """Densities that are known already, as a function of the grids that they came from."""

    @staticmethod
    def forward(
        ctx: Any,
        backward: Callable[..., Any],
        density: Tensor,
        u: Tensor,
        scale: float,
        read: int,
        *grids: Tensor,
    ) -> Tensor:
        ctx.backward_pass, ctx.scale, ctx.read = backward, scale, read
        ctx.save_for_backward(density, u, *grids)
        return density.clone()

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> tuple[Any, ...]:
        density, u, *grids = ctx.saved_tensors
        # The derivative of softplus is 1 - exp(-softplus), and 0 where the density is 0: outside the box.
        upstream = torch.expm1(density / -ctx.scale).mul_(upstream).mul_(-ctx.scale)
        upstream = round_stochastically(upstream, rounding_fraction())
        return (None, None, None, None, None, *_gradients(ctx, u, grids, upstream))


@vm_ops.vm_march_density.register_cpu()
def _march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> RayMarchResult:
    """March without planes through a CP grid, else through a VM grid."""
    lines, read = _opened(lines, open_channels)
    grids = (*planes, *lines)
    parts = _parts(grids)
    found, u = march_density(
        mark(march),
        parts[0] if planes else (),
        parts[-1],
        read=read,
        activation=activation,
        step=march.step,
        transmittance_bound=transmittance_bound,
    )
    backward = vm_gradient.density_backward if planes else cp.density_backward
    density: Tensor = _Activated.apply(backward, found.density, u, activation.scale, read, *grids)  # type: ignore[no-untyped-call]
    return found._replace(density=density)


@cp_ops.cp_march_density.register_cpu()
def _cp_march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> RayMarchResult:
    return _march_density(march, activation, transmittance_bound, (), lines, open_channels)


def _lookup(
    forward: Callable[..., Tensor],
    backward: Callable[..., Any],
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None,
) -> Tensor:
    lines, read = _opened(lines, open_channels)
    out: Tensor = _Lookup.apply(forward, backward, u, read, *planes, *lines)  # type: ignore[no-untyped-call]
    return out


@vm_ops.vm_density.register_cpu(suits=suits_cpu)
def _vm_density(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    return _lookup(vm.density, vm_gradient.density_backward, u, planes, lines, open_channels)


@vm_ops.vm_features.register_cpu(suits=suits_cpu)
def _vm_features(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    return _lookup(
        partial(vm.features, dtype=dtype), vm_gradient.features_backward, u, planes, lines, open_channels
    )


@cp_ops.cp_density.register_cpu(suits=suits_cpu)
def _cp_density(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    return _lookup(cp.density, cp.density_backward, u, (), lines, open_channels)


@cp_ops.cp_features.register_cpu(suits=suits_cpu)
def _cp_features(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    return _lookup(cp.features, cp.features_backward, u, (), lines, open_channels)
