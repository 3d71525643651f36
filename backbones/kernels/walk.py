"""Density along rays with early termination: samples that cannot be seen are hardly ever computed.

A task walks along some rays from sample to sample, and leaves a ray where its transmittance falls below a bound.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from backbones.kernels.activation import Activation
from backbones.kernels.compiler import (
    exact,
    float32,
    inline,
    int32,
    int64,
    integer,
    kernel,
    next_task,
    real,
    scratch,
    size,
    vector,
)
from backbones.kernels.cp import product_sum
from backbones.kernels.places import BATCH, PLACES, find
from backbones.kernels.simd import LANES, load, store, wide
from backbones.kernels.softplus import softplus
from backbones.kernels.threading import launch
from backbones.kernels.vm import find_cells, look_up

__all__ = ["Walked", "walk"]

# Samples between two looks at the transmittance: so many may be computed in vain behind the last one.
_GROUP = LANES
# Samples placed on the grid at a time, of which most may be in vain.
_SPAN = 64
# Rays of a task.
_RAYS = 16


@dataclass(frozen=True)
class Walked:
    """The samples that can be seen.

    Args:
        offsets: ``(R + 1,)`` int64.
        index: ``(N,)`` int64.
        t: ``(N,)``, world units.
        positions: ``(N, 3)``, world units.
        u: ``(N, 3)``, the positions normalised to the box.
        density: ``(N,)``, per world unit.
    """

    offsets: Tensor
    index: Tensor
    t: Tensor
    positions: Tensor
    u: Tensor
    density: Tensor


# Rounded as the plain version does it, so that both agree on what is inside.
@exact
def _normalise(x: Any, box: Any, first: Any, last: Any, u: Any) -> Any:
    for axis in range(3):
        lower, edge = box[axis], box[3 + axis] - box[axis]
        for n in range(first, last):
            u[3 * n + axis] = (x[3 * n + axis] - lower) / edge


@inline
def _cp_feature(table: Any, places: Any, q: Any, channels: Any, read: Any) -> Any:
    """Sum over channels at sample ``q`` of a batch."""
    nodes, shares = places
    lines = vector(table, 10, float32), vector(table, 9, float32), vector(table, 8, float32)
    x, y, z = int64(nodes[q]), int64(nodes[BATCH + q]), int64(nodes[2 * BATCH + q])
    between = shares[q], shares[BATCH + q], shares[2 * BATCH + q]
    return product_sum(lines, (x * channels, y * channels, z * channels), between, channels, read)


@inline
def _outside(u: Any, n: Any) -> Any:
    x, y, z = u[3 * n], u[3 * n + 1], u[3 * n + 2]
    return (
        (x < float32(0))
        | (x > float32(1))
        | (y < float32(0))
        | (y > float32(1))
        | (z < float32(0))
        | (z > float32(1))
    )


@inline
def _walk_ray(table: Any, begin: Any, end: Any, places: Any, cells: Any, features: Any, planar: Any) -> Any:
    """Fill u and density of the samples of a ray until it is opaque, and return how many can be seen."""
    x, box, u, density = (
        vector(table, 0, float32),
        vector(table, 2, float32),
        vector(table, 3, float32),
        vector(table, 4, float32),
    )
    read, shift, scale, step, limit = (
        integer(table, 11),
        real(table, 12),
        real(table, 13),
        real(table, 14),
        real(table, 15),
    )
    channels = size(table, 8, 1)
    shape = size(table, 10, 0), size(table, 9, 0), size(table, 8, 0)
    depth = float32(0)
    for first in range(begin, end, _SPAN):
        count = min(int64(_SPAN), end - first)
        _normalise(x, box, first, first + count, u)
        find(places, u, first, count, shape)
        if planar:
            find_cells(cells, places[0], count, shape, channels)
        for start in range(0, count, _GROUP):
            stop = min(start + _GROUP, count)
            if planar:
                for k in range(3):
                    grids = vector(table, 5 + k, float32), vector(table, 8 + k, float32)
                    look_up(
                        grids,
                        k,
                        cells,
                        places,
                        (start, stop, count),
                        shape,
                        channels,
                        read,
                        features,
                        0,
                        True,
                    )
            else:
                for q in range(start, stop):
                    features[q] = _cp_feature(table, places, q, channels, read)
            # The last group of a ray is filled up with leftovers.
            values = softplus(load(features, start, wide()) + shift, wide()) * scale
            store(features, start, values)
            for q in range(start, stop):
                if depth > limit:
                    return first + q - begin
                value = float32(0) if _outside(u, first + q) else features[q]
                density[first + q] = value
                depth += value * step
    return end - begin


@inline
def _walk(table: Any, planar: Any) -> Any:
    offsets, counts = vector(table, 1, int64), vector(table, 16, int64)
    places = scratch(PLACES, int32), scratch(PLACES, float32)
    cells, features = scratch(PLACES, int32), scratch(BATCH, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for ray in range(task * _RAYS, min((task + 1) * _RAYS, counts.shape[0])):
            counts[ray] = _walk_ray(table, offsets[ray], offsets[ray + 1], places, cells, features, planar)


@kernel
def _vm_walk(table: Any) -> None:
    """positions, offsets, box, u, density, planes, lines, channels to read, shift, scale, step, limit, counts."""
    _walk(table, True)


@kernel
def _cp_walk(table: Any) -> None:
    """Arguments as of `_vm_walk`; planes are not read."""
    _walk(table, False)


@kernel
def _pack(table: Any) -> None:
    """Old offsets, new offsets, then index, t, positions, u, density, from and to."""
    old, new = vector(table, 0, int64), vector(table, 1, int64)
    index, t, x = vector(table, 2, int64), vector(table, 3, float32), vector(table, 4, float32)
    u, density = vector(table, 5, float32), vector(table, 6, float32)
    to_index, to_t, to_x = vector(table, 7, int64), vector(table, 8, float32), vector(table, 9, float32)
    to_u, to_density = vector(table, 10, float32), vector(table, 11, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for ray in range(task * _RAYS, min((task + 1) * _RAYS, old.shape[0] - 1)):
            start = old[ray] - new[ray]
            for n in range(new[ray], new[ray + 1]):
                to_index[n], to_t[n], to_density[n] = index[n + start], t[n + start], density[n + start]
            start *= 3
            for n in range(3 * new[ray], 3 * new[ray + 1]):
                to_x[n], to_u[n] = x[n + start], u[n + start]


def walk(
    marched: tuple[Tensor, Tensor, Tensor, Tensor],
    *grids: Sequence[Tensor],
    read: int,
    activation: Activation,
    step: float,
    transmittance_bound: float,
) -> Walked:
    """Density at marched samples up to where a ray is opaque.

    Args:
        marched: offsets, index, t and positions, as `backbones.kernels.march.march` returns them.
        grids: three planes, unless the grid is a CP grid, and three lines.
        read: number of channels to use.
        activation: from features to densities.
        step: length of a sample's interval, world units.
        transmittance_bound: samples behind a smaller transmittance are dropped.
    """
    planar, lines = len(grids) > 1, grids[-1]
    offsets, index, t, positions = marched
    rays, samples = offsets.shape[0] - 1, positions.shape[0]
    tasks = -(-rays // _RAYS)
    u, density = torch.empty(samples, 3), torch.empty(samples)
    counts = torch.empty(rays, dtype=torch.int64)
    limit = -math.log(transmittance_bound) if transmittance_bound > 0 else math.inf
    # A CP grid gives its lines once more in place of planes, which are not read then.
    launch(
        _vm_walk if planar else _cp_walk, tasks, positions, offsets, activation.bounds.contiguous(), u, density,
        *grids[0], *lines, read, float(activation.shift), float(activation.scale), float(step), limit, counts,
    )  # fmt: skip
    seen = torch.zeros_like(offsets)
    torch.cumsum(counts, 0, out=seen[1:])
    kept = int(seen[-1])
    if kept == samples:
        return Walked(offsets, index, t, positions, u, density)
    packed = (
        torch.empty(kept, dtype=torch.int64),
        torch.empty(kept),
        torch.empty(kept, 3),
        torch.empty(kept, 3),
        torch.empty(kept),
    )
    launch(_pack, tasks if kept else 0, offsets, seen, index, t, positions, u, density, *packed)
    return Walked(seen, *packed)
