"""Compiled merging of low-weight samples, and the colours that they share."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.ops import merging as ops
from gridreg.ops.cpu.jit.compiler import inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.table import Matrix, Vector, float32, float64, int64

# Rays of one task; samples or groups of one.
_RAYS = 64
_SAMPLES = 4096


@inline
def _amount(weight: float32) -> int64:
    """A weight as an integer, at least 1."""
    return max(int64(float64(weight) * ops.UNIT), int64(1))


@inline
def _merge_next(
    weights: Vector[float32], n: int, end: int, floor: float32, bound: float32, unit: int, passed: int
) -> tuple[int, int, int]:
    """Merge consecutive low-weight samples, starting at ``n``, which weighs more than the floor.

    Args:
        passed: total weight of the ray's low-weight samples before.

    Returns:
        Their total weight, the index after the last one, and ``passed`` there.
    """
    if weights[n] >= bound:
        return _amount(weights[n]), n + 1, passed
    bucket, total = passed // unit, int64(0)
    while n < end:
        if weights[n] > floor:
            if weights[n] >= bound or passed // unit != bucket:
                break
            amount = _amount(weights[n])
            total += amount
            passed += amount
        n += 1
    return total, n, passed


@kernel
def _count(
    task: int, offsets: Vector[int64], weights: Vector[float32], floor: float32, bound: float32, unit: int64,
    counts: Vector[int64],
) -> None:  # fmt: skip
    """Count the groups of each ray."""
    rays = counts.shape[0]
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
        found, n, end, passed = int64(0), offsets[ray], offsets[ray + 1], int64(0)
        while n < end:
            if weights[n] > floor:
                _, n, passed = _merge_next(weights, n, end, floor, bound, unit, passed)
                found += 1
            else:
                n += 1
        counts[ray] = found


@kernel
def _fill(
    task: int, offsets: Vector[int64], weights: Vector[float32], floor: float32, bound: float32, unit: int64,
    starts: Vector[int64], drawn: Vector[float64], representatives: Vector[int64], rays: Vector[int64],
    groups: Vector[int64],
) -> None:  # fmt: skip
    """Write the groups, from the first one of each ray ``(R + 1,)`` and numbers in [0, 1) or none."""
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, starts.shape[0] - 1)):
        group, n, end, passed = starts[ray], offsets[ray], offsets[ray + 1], int64(0)
        while n < end:
            if not weights[n] > floor:
                groups[n] = -1
                n += 1
                continue
            total, behind, passed = _merge_next(weights, n, end, floor, bound, unit, passed)
            left = total // 2
            if drawn.shape[0] > 0:
                left = min(int64(drawn[group] * float64(total)), total - 1)
            representative = int64(-1)
            while n < behind:
                groups[n] = -1
                if weights[n] > floor:
                    groups[n] = group
                    left -= _amount(weights[n])
                    if left < 0 and representative < 0:
                        representative = n
                n += 1
            representatives[group], rays[group] = representative, ray
            group += 1


@ops.merge_samples.register_cpu()
def merge_samples(
    weights: Tensor, offsets: Tensor, floor: float, bound: float, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `gridreg.ops.merge_samples`."""
    weights, offsets = weights.detach().contiguous(), offsets.contiguous()
    starts = torch.zeros(offsets.shape[0], dtype=torch.int64)
    tasks = -(-(len(offsets) - 1) // _RAYS)
    settings = (offsets, weights, float(floor), float(bound), max(1, int(bound * ops.UNIT)))
    launch(_count, tasks, *settings, starts[1:])
    torch.cumsum(starts[1:], 0, out=starts[1:])
    count = int(starts[-1])
    drawn = torch.empty(0, dtype=torch.float64)
    if generator is not None and bound > floor:
        drawn = torch.rand(count, generator=generator, dtype=torch.float64)
    representatives, rays = torch.empty(2, count, dtype=torch.int64)
    groups = torch.empty(weights.shape[0], dtype=torch.int64)
    launch(_fill, tasks, *settings, starts, drawn, representatives, rays, groups)
    return representatives, rays, groups


@kernel
def _spread(task: int, colours: Matrix[float32], groups: Vector[int64], out: Matrix[float32]) -> None:
    """Copy colours ``(G, C)`` to the samples of each group ``(N, C)``."""
    channels = out.shape[1]
    for n in range(task * _SAMPLES, min((task + 1) * _SAMPLES, out.shape[0])):
        group = groups[n]
        for k in range(channels):
            out[n, k] = colours[group, k] if group >= 0 else float32(0)


@kernel
def _gather(
    task: int, gradient: Matrix[float32], groups: Vector[int64], representatives: Vector[int64],
    out: Matrix[float32],
) -> None:  # fmt: skip
    """Add the gradients of samples ``(N, C)`` up by group ``(G, C)``."""
    channels, samples = out.shape[1], gradient.shape[0]
    for group in range(task * _SAMPLES, min((task + 1) * _SAMPLES, out.shape[0])):
        # A group lies around its representative, with nothing between its samples but what is in no group.
        first = representatives[group]
        while first > 0 and (groups[first - 1] == group or groups[first - 1] < 0):
            first -= 1
        for k in range(channels):
            out[group, k] = float32(0)
        n = first
        while n < samples and (groups[n] == group or groups[n] < 0):
            if groups[n] == group:
                for k in range(channels):
                    out[group, k] += gradient[n, k]
            n += 1


class _Spread(Function):
    @staticmethod
    def forward(ctx: Any, colours: Tensor, groups: Tensor, representatives: Tensor) -> Tensor:
        ctx.save_for_backward(groups, representatives)
        out = torch.empty(groups.shape[0], colours.shape[1])
        launch(_spread, -(-len(groups) // _SAMPLES), colours.detach().contiguous(), groups, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        groups, representatives = ctx.saved_tensors
        out = torch.empty(representatives.shape[0], gradient.shape[1])
        tasks = -(-len(representatives) // _SAMPLES)
        launch(_gather, tasks, gradient.contiguous(), groups, representatives, out)
        return out, None, None


@ops.spread_to_samples.register_cpu()
def spread_to_samples(colours: Tensor, groups: Tensor, representatives: Tensor) -> Tensor:
    """See `gridreg.ops.spread_to_samples`."""
    return _Spread.apply(colours, groups, representatives)  # type: ignore[no-any-return, no-untyped-call]
