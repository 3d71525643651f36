"""Backward passes that add to the gradient buffers of grids in place."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor

_local = threading.local()


@contextmanager
def accumulate_into_grad(rounding: float = 0.0) -> Iterator[None]:
    """Let compiled backward passes add to the ``.grad`` of planes in place, instead of handing out a new tensor.

    For training loops that keep their gradient buffers: a 300^3 grid has 70 MB of them, and to allocate, fill and
    add as much again in every iteration costs more than the gradient itself. It holds for backward passes that this
    thread starts, and for planes that are leaves; hooks of such planes are not called. Plain versions ignore it.

    Args:
        rounding: stochastic rounding of the gradients of marched densities: those below this fraction of their mean
            size become 0 or the fraction at random, so that their expectation stays. What is 0 is not added to the
            grids, and most samples lie where hardly anything is. 0: none.

    Example:
        >>> from gridreg import ops
        >>> grids = [torch.ones(2, 2, 4, requires_grad=True) for _ in range(3)], [torch.ones(2, 4)] * 3
        >>> with accumulate_into_grad():
        ...     ops.vm_density(torch.zeros(1, 3), *grids).sum().backward()
        >>> float(grids[0][0].grad.sum())
        4.0
    """
    previous = getattr(_local, "in_place", False), getattr(_local, "rounding", 0.0)
    _local.in_place, _local.rounding = True, rounding
    try:
        yield
    finally:
        _local.in_place, _local.rounding = previous


def rounding_fraction() -> float:
    """The ``rounding`` of the `accumulate_into_grad` in force on this thread; 0 without one."""
    return getattr(_local, "rounding", 0.0)


def gradient_buffers(planes: Sequence[Tensor]) -> tuple[list[Tensor], list[Tensor | None]]:
    """Buffers that a backward pass adds to, and what it returns to autograd: None where a buffer is the ``.grad``."""
    buffers: list[Tensor] = []
    returned: list[Tensor | None] = []
    for plane in planes:
        if getattr(_local, "in_place", False) and plane.is_leaf and plane.requires_grad:
            if plane.grad is None:
                plane.grad = torch.zeros_like(plane, memory_format=torch.contiguous_format)
            if plane.grad.is_contiguous():
                buffers.append(plane.grad)
                returned.append(None)
                continue
        buffers.append(torch.zeros_like(plane, memory_format=torch.contiguous_format))
        returned.append(buffers[-1])
    return buffers, returned
