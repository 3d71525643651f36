"""Compiled merging of low-weight samples, and the colours that they share."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.ops import merging as ops
from gridreg.ops.cpu.jit.compiler import (
    float32,
    inline,
    int64,
    integer,
    kernel,
    matrix,
    next_task,
    real,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch

__all__ = ["merge_samples", "spread_to_samples"]

# Rays of one task; samples or pools of one.
_RAYS = 64
_SAMPLES = 4096


@inline
def _amount(weight: Any) -> Any:
    """A weight as an integer, at least 1."""
    return max(int64(np.float64(weight) * ops.UNIT), int64(1))


@inline
def _next_pool(weights: Any, n: int, end: int, floor: Any, bound: Any, unit: int, passed: int) -> Any:
    """Of the pool that begins at sample n, which weighs more than the floor: total, sample behind it, passed then.

    ``passed``: total of the ray's faint samples before.
    """
    if weights[n] >= bound:
        return _amount(weights[n]), n + 1, passed
    bucket, sum_ = passed // unit, int64(0)
    while n < end:
        if weights[n] > floor:
            if weights[n] >= bound or passed // unit != bucket:
                break
            amount = _amount(weights[n])
            sum_ += amount
            passed += amount
        n += 1
    return sum_, n, passed


@kernel
def _count(table: Any) -> None:
    """Offsets, weights, counts ``(R,)`` of pools, floor, bound, unit."""
    offsets, weights, counts = vector(table, 0, int64), vector(table, 1, float32), vector(table, 2, int64)
    floor, bound, unit = float32(real(table, 3)), float32(real(table, 4)), integer(table, 5)
    rays = counts.shape[0]
    while True:
        task = next_task(table)
        if task < 0:
            break
        for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
            found, n, end, passed = int64(0), offsets[ray], offsets[ray + 1], int64(0)
            while n < end:
                if weights[n] > floor:
                    _, n, passed = _next_pool(weights, n, end, floor, bound, unit, passed)
                    found += 1
                else:
                    n += 1
            counts[ray] = found


@kernel
def _fill(table: Any) -> None:
    """As `_count`, with the first pool of each ray ``(R + 1,)`` for the counts; then numbers in [0, 1) or none, and the
    results: speakers, their rays, pool of each sample."""
    offsets, weights, starts = vector(table, 0, int64), vector(table, 1, float32), vector(table, 2, int64)
    floor, bound, unit = float32(real(table, 3)), float32(real(table, 4)), integer(table, 5)
    drawn = vector(table, 6, np.float64)
    speakers, of_ray, pools = vector(table, 7, int64), vector(table, 8, int64), vector(table, 9, int64)
    rays = starts.shape[0] - 1
    while True:
        task = next_task(table)
        if task < 0:
            break
        for ray in range(task * _RAYS, min((task + 1) * _RAYS, rays)):
            pool, n, end, passed = starts[ray], offsets[ray], offsets[ray + 1], int64(0)
            while n < end:
                if not weights[n] > floor:
                    pools[n] = -1
                    n += 1
                    continue
                total, behind, passed = _next_pool(weights, n, end, floor, bound, unit, passed)
                share = total // 2
                if drawn.shape[0] > 0:
                    share = min(int64(drawn[pool] * np.float64(total)), total - 1)
                speaker = int64(-1)
                while n < behind:
                    pools[n] = -1
                    if weights[n] > floor:
                        pools[n] = pool
                        share -= _amount(weights[n])
                        if share < 0 and speaker < 0:
                            speaker = n
                    n += 1
                speakers[pool], of_ray[pool] = speaker, ray
                pool += 1


@ops.merge_samples.register_cpu()
def merge_samples(
    weights: Tensor, offsets: Tensor, floor: float, bound: float, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `gridreg.ops.merge_samples`."""
    weights, offsets = weights.detach().contiguous(), offsets.contiguous()
    rays = offsets.shape[0] - 1
    starts = torch.zeros(rays + 1, dtype=torch.int64)
    tasks = -(-rays // _RAYS)
    numbers = (float(floor), float(bound), max(1, int(bound * ops.UNIT)))
    launch(_count, tasks, offsets, weights, starts[1:], *numbers)
    torch.cumsum(starts[1:], 0, out=starts[1:])
    count = int(starts[-1])
    drawn = torch.empty(0, dtype=torch.float64)
    if generator is not None and bound > floor:
        drawn = torch.rand(count, generator=generator, dtype=torch.float64)
    speakers, of_ray = torch.empty(2, count, dtype=torch.int64)
    pools = torch.empty(weights.shape[0], dtype=torch.int64)
    launch(_fill, tasks, offsets, weights, starts, *numbers, drawn, speakers, of_ray, pools)
    return speakers, of_ray, pools


@kernel
def _spread(table: Any) -> None:
    """Colours ``(P, C)``, pool of each sample, colours of the samples ``(N, C)``."""
    colours, pools = matrix(table, 0, float32), vector(table, 1, int64)
    out = matrix(table, 2, float32)
    channels = out.shape[1]
    while True:
        task = next_task(table)
        if task < 0:
            break
        for n in range(task * _SAMPLES, min((task + 1) * _SAMPLES, out.shape[0])):
            number = pools[n]
            for k in range(channels):
                out[n, k] = colours[number, k] if number >= 0 else float32(0)


@kernel
def _gather(table: Any) -> None:
    """Speakers, gradients of samples ``(N, C)``, pool of each sample; gradients of colours ``(P, C)``."""
    speakers, gradient = vector(table, 0, int64), matrix(table, 1, float32)
    pools, out = vector(table, 2, int64), matrix(table, 3, float32)
    channels, samples = out.shape[1], gradient.shape[0]
    while True:
        task = next_task(table)
        if task < 0:
            break
        for number in range(task * _SAMPLES, min((task + 1) * _SAMPLES, out.shape[0])):
            # A pool lies around its speaker, with nothing between its members but what is in no pool.
            first = speakers[number]
            while first > 0 and (pools[first - 1] == number or pools[first - 1] < 0):
                first -= 1
            for k in range(channels):
                out[number, k] = float32(0)
            n = first
            while n < samples and (pools[n] == number or pools[n] < 0):
                if pools[n] == number:
                    for k in range(channels):
                        out[number, k] += gradient[n, k]
                n += 1


class _Spread(Function):
    @staticmethod
    def forward(ctx: Any, colours: Tensor, pools: Tensor, speakers: Tensor) -> Tensor:
        ctx.save_for_backward(pools, speakers)
        out = torch.empty(pools.shape[0], colours.shape[1])
        launch(_spread, -(-len(pools) // _SAMPLES), colours.detach().contiguous(), pools, out)
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        pools, speakers = ctx.saved_tensors
        out = torch.empty(speakers.shape[0], gradient.shape[1])
        tasks = -(-len(speakers) // _SAMPLES)
        launch(_gather, tasks, speakers, gradient.contiguous(), pools, out)
        return out, None, None


@ops.spread_to_samples.register_cpu()
def spread_to_samples(colours: Tensor, groups: Tensor, representatives: Tensor) -> Tensor:
    """See `gridreg.ops.spread_to_samples`."""
    return _Spread.apply(colours, groups, representatives)  # type: ignore[no-any-return, no-untyped-call]
