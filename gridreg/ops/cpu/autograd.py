"""Compiled lookups as differentiable functions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from gridreg.ops.arguments import Activation, MarchArguments
from gridreg.ops.cpu import cp, vm, vm_gradient
from gridreg.ops.cpu.jit.simd import LANES
from gridreg.ops.cpu.march import mark
from gridreg.ops.cpu.march_density import walk
from gridreg.ops.cpu.reductions import thin

__all__ = ["accumulate_into_grad", "cp_density", "cp_features", "march_density", "vm_density", "vm_features"]

_local = threading.local()


@contextmanager
def accumulate_into_grad(faint: float = 0.0) -> Iterator[None]:
    """Let compiled backward passes add to the ``.grad`` of planes in place, instead of handing out a new tensor.

    For training loops that keep their gradient buffers: a 300^3 grid has 70 MB of them, and to allocate, fill and
    add as much again in every iteration costs more than the gradient itself. It holds for backward passes that this
    thread starts, and for planes that are leaves; hooks of such planes are not called.

    Args:
        faint: gradients of marched densities below this share of their mean size are rounded at random, to 0 or to the
            share, so that their expectation stays: see `gridreg.ops.cpu.reductions.thin`. What is 0 is not added to the
            grids, and most samples lie where hardly anything is. 0: all of them count.

    Example:
        >>> grids = [torch.ones(2, 2, 4, requires_grad=True) for _ in range(3)], [torch.ones(2, 4)] * 3
        >>> with accumulate_into_grad():
        ...     vm_density(torch.zeros(1, 3), *grids, 4).sum().backward()
        >>> float(grids[0][0].grad.sum())
        4.0
    """
    previous = getattr(_local, "in_place", False), getattr(_local, "faint", 0.0)
    _local.in_place, _local.faint = True, faint
    try:
        yield
    finally:
        _local.in_place, _local.faint = previous


def _gradient_buffers(planes: Sequence[Tensor], in_place: bool) -> tuple[list[Tensor], list[Tensor | None]]:
    """Where a backward pass adds to, and what it returns to autograd."""
    buffers: list[Tensor] = []
    returned: list[Tensor | None] = []
    for plane in planes:
        if in_place and plane.is_leaf and plane.requires_grad:
            if plane.grad is None:
                plane.grad = torch.zeros_like(plane, memory_format=torch.contiguous_format)
            if plane.grad.is_contiguous():
                buffers.append(plane.grad)
                returned.append(None)
                continue
        buffers.append(torch.zeros_like(plane, memory_format=torch.contiguous_format))
        returned.append(buffers[-1])
    return buffers, returned


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
    """What a backward pass returns for the grids."""
    buffers, returned = _gradient_buffers(grids[:-3], getattr(_local, "in_place", False))
    given = [buffers] if buffers else []
    lines = ctx.backward_pass(
        u.detach().contiguous(), *_parts(grids), ctx.read, upstream.contiguous(), *given
    )
    return [*returned, *lines]


def _parts(grids: Sequence[Tensor]) -> list[list[Tensor]]:
    """Planes, if there are any, and lines, as kernels want them."""
    contiguous = [grid.detach().contiguous() for grid in grids]
    return [contiguous[:-3], contiguous[-3:]] if len(grids) > 3 else [contiguous]


def _opened(lines: Sequence[Tensor], open_channels: int) -> tuple[Sequence[Tensor], int]:
    """Lines without closed channels, and how many channels to read."""
    channels = lines[0].shape[1]
    if open_channels >= channels:
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
        upstream = thin(upstream, getattr(_local, "faint", 0.0))
        return (None, None, None, None, None, *_gradients(ctx, u, grids, upstream))


def march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """See `gridreg.ops.vm_march_density`; without planes, a CP grid."""
    lines, read = _opened(lines, open_channels)
    grids = (*planes, *lines)
    found = walk(
        mark(*march),
        *_parts(grids),
        read=read,
        activation=activation,
        step=march.step,
        transmittance_bound=transmittance_bound,
    )
    backward = vm_gradient.density_backward if planes else cp.density_backward
    density: Tensor = _Activated.apply(backward, found.density, found.u, activation.scale, read, *grids)  # type: ignore[no-untyped-call]
    return found.offsets, found.index, found.t, found.positions, density


def _lookup(
    forward: Callable[..., Tensor],
    backward: Callable[..., Any],
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int,
) -> Tensor:
    lines, read = _opened(lines, open_channels)
    out: Tensor = _Lookup.apply(forward, backward, u, read, *planes, *lines)  # type: ignore[no-untyped-call]
    return out


def vm_density(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int) -> Tensor:
    """See `gridreg.ops.vm_density`."""
    return _lookup(vm.density, vm_gradient.density_backward, u, planes, lines, open_channels)


def vm_features(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int, dtype: torch.dtype
) -> Tensor:
    """See `gridreg.ops.vm_features`."""
    forward = vm.low_features if dtype == torch.bfloat16 else vm.features
    return _lookup(forward, vm_gradient.features_backward, u, planes, lines, open_channels)


def cp_density(u: Tensor, lines: Sequence[Tensor], open_channels: int) -> Tensor:
    """See `gridreg.ops.cp_density`."""
    return _lookup(cp.density, cp.density_backward, u, (), lines, open_channels)


def cp_features(u: Tensor, lines: Sequence[Tensor], open_channels: int) -> Tensor:
    """See `gridreg.ops.cp_features`."""
    return _lookup(cp.features, cp.features_backward, u, (), lines, open_channels)
