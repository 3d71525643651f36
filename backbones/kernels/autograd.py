"""Compiled lookups as differentiable functions."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor

from backbones.kernels import vm, vm_gradient

__all__ = ["accumulate_into_grad", "vm_density", "vm_features"]

_local = threading.local()


@contextmanager
def accumulate_into_grad() -> Iterator[None]:
    """Let compiled backward passes add to the ``.grad`` of planes in place, instead of handing out a new tensor.

    For training loops that keep their gradient buffers: a 300^3 grid has 70 MB of them, and to allocate, fill and
    add as much again in every iteration costs more than the gradient itself. It holds for backward passes that this
    thread starts, and for planes that are leaves; hooks of such planes are not called.

    Example:
        >>> grids = [torch.ones(2, 2, 4, requires_grad=True) for _ in range(3)], [torch.ones(2, 4)] * 3
        >>> with accumulate_into_grad():
        ...     vm_density(torch.zeros(1, 3), *grids, 4).sum().backward()
        >>> float(grids[0][0].grad.sum())
        4.0
    """
    previous = getattr(_local, "in_place", False)
    _local.in_place = True
    try:
        yield
    finally:
        _local.in_place = previous


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
    """A lookup of VM grids with its compiled backward pass."""

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
        detached = [grid.detach().contiguous() for grid in grids]
        return forward(u.detach().contiguous(), detached[:3], detached[3:], read)

    @staticmethod
    @torch.autograd.function.once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> tuple[Any, ...]:
        u, *grids = ctx.saved_tensors
        planes = grids[:3]
        buffers, returned = _gradient_buffers(planes, getattr(_local, "in_place", False))
        contiguous = [grid.detach().contiguous() for grid in grids]
        lines = ctx.backward_pass(
            u.detach().contiguous(), contiguous[:3], contiguous[3:], ctx.read, upstream.contiguous(), buffers
        )
        return (None, None, None, None, *returned, *lines)


def _opened(lines: Sequence[Tensor], open_channels: int) -> tuple[list[Tensor], int]:
    """Lines with closed channels set to 0, and how many channels to read, full vectors of them if there are as many."""
    channels = lines[0].shape[1]
    if open_channels >= channels:
        return list(lines), channels
    opened = [
        torch.cat([line[:, :open_channels], torch.zeros_like(line[:, open_channels:])], 1) for line in lines
    ]
    return opened, min(channels, -(-open_channels // 8) * 8)


def vm_density(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int) -> Tensor:
    """See `backbones.kernels.vm_density`."""
    lines, read = _opened(lines, open_channels)
    out: Tensor = _Lookup.apply(vm.density, vm_gradient.density_backward, u, read, *planes, *lines)  # type: ignore[no-untyped-call]
    return out


def vm_features(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int) -> Tensor:
    """See `backbones.kernels.vm_features`."""
    lines, read = _opened(lines, open_channels)
    out: Tensor = _Lookup.apply(vm.features, vm_gradient.features_backward, u, read, *planes, *lines)  # type: ignore[no-untyped-call]
    return out
