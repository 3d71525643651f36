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

from gridreg.ops.cpu.cp import product_sum
from gridreg.ops.cpu.grid_coordinates import BATCH, PLACES, find
from gridreg.ops.cpu.jit.compiler import (
    exact,
    float32,
    inline,
    int32,
    int64,
    integer,
    kernel,
    matrix,
    next_task,
    real,
    scratch,
    size,
    vector,
)
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, store, wide
from gridreg.ops.cpu.jit.softplus import softplus
from gridreg.ops.cpu.march_bits import MarchBits, distance_of, next_bit, sample_at
from gridreg.ops.cpu.vm import find_cells, look_up
from gridreg.ops.ray_marching import Activation

__all__ = ["Walked", "walk"]

# Samples between two looks at the transmittance: so many may be computed in vain behind the last one.
_GROUP = LANES
# Samples placed on the grid at a time, of which most may be in vain.
_SPAN = 64
_COORDINATES = 3 * _SPAN
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
def _normalised(x: Any, box: Any, axis: Any) -> Any:
    return (x - box[axis]) / (box[3 + axis] - box[axis])


@inline
def _cp_feature(table: Any, places: Any, q: Any, channels: Any, read: Any) -> Any:
    """Sum over channels at sample ``q`` of a batch."""
    nodes, shares = places
    lines = vector(table, 13, float32), vector(table, 12, float32), vector(table, 11, float32)
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
def _place(table: Any, ray: Any, i: Any, count: Any, u: Any) -> Any:
    """Find the next samples of a ray behind index ``i``, normalise them to u, and return the last one's index."""
    o, d = matrix(table, 0, float32), matrix(table, 1, float32)
    near, shift, bits = vector(table, 2, float32), vector(table, 3, float32), matrix(table, 4, int64)
    box, step = vector(table, 6, float32), real(table, 17)
    for q in range(count):
        i = next_bit(bits[ray], i + 1)
        distance = distance_of(near[ray], shift[ray], step, i)
        for axis in range(3):
            u[3 * q + axis] = _normalised(sample_at(o[ray], d[ray], axis, distance), box, axis)
    return i


@inline
def _walk_ray(table: Any, ray: Any, u: Any, places: Any, cells: Any, features: Any, planar: Any) -> Any:
    """Fill density of the samples of a ray until it is opaque, and return how many can be seen."""
    offsets, density = vector(table, 5, int64), vector(table, 7, float32)
    read, shift, scale = integer(table, 14), real(table, 15), real(table, 16)
    step, limit = real(table, 17), real(table, 18)
    channels = size(table, 11, 1)
    shape = size(table, 13, 0), size(table, 12, 0), size(table, 11, 0)
    begin, end = offsets[ray], offsets[ray + 1]
    depth, index = float32(0), int64(-1)
    for first in range(begin, end, _SPAN):
        count = min(int64(_SPAN), end - first)
        index = _place(table, ray, index, count, u)
        find(places, u, 0, count, shape)
        if planar:
            find_cells(cells, places[0], count, shape, channels)
        for start in range(0, count, _GROUP):
            stop = min(start + _GROUP, count)
            if planar:
                for k in range(3):
                    grids = vector(table, 8 + k, float32), vector(table, 11 + k, float32)
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
                value = float32(0) if _outside(u, q) else features[q]
                density[first + q] = value
                depth += value * step
    return end - begin


@inline
def _walk(table: Any, planar: Any) -> Any:
    counts = vector(table, 19, int64)
    u, places = scratch(_COORDINATES, float32), (scratch(PLACES, int32), scratch(PLACES, float32))
    cells, features = scratch(PLACES, int32), scratch(BATCH, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for ray in range(task * _RAYS, min((task + 1) * _RAYS, counts.shape[0])):
            counts[ray] = _walk_ray(table, ray, u, places, cells, features, planar)


@kernel
def _vm_walk(table: Any) -> None:
    """origins, directions, near, shift, bits, offsets, box, density, planes, lines, channels to read, shift, scale,
    step, limit, counts."""
    _walk(table, True)


@kernel
def _cp_walk(table: Any) -> None:
    """Arguments as of `_vm_walk`; planes are not read."""
    _walk(table, False)


@kernel
def _write(table: Any) -> None:
    """The first six as of `_vm_walk`, then new offsets, box, density, step; index, t, positions, u,
    density."""
    o, d = matrix(table, 0, float32), matrix(table, 1, float32)
    near, shift, bits = vector(table, 2, float32), vector(table, 3, float32), matrix(table, 4, int64)
    old, new = vector(table, 5, int64), vector(table, 6, int64)
    box, density, step = vector(table, 7, float32), vector(table, 8, float32), real(table, 9)
    index, t, x = vector(table, 10, int64), vector(table, 11, float32), vector(table, 12, float32)
    u, to_density = vector(table, 13, float32), vector(table, 14, float32)
    while True:
        task = next_task(table)
        if task < 0:
            break
        for ray in range(task * _RAYS, min((task + 1) * _RAYS, old.shape[0] - 1)):
            start, i = old[ray] - new[ray], int64(-1)
            for n in range(new[ray], new[ray + 1]):
                i = next_bit(bits[ray], i + 1)
                distance = distance_of(near[ray], shift[ray], step, i)
                index[n], t[n], to_density[n] = i, distance, density[n + start]
                for axis in range(3):
                    coordinate = sample_at(o[ray], d[ray], axis, distance)
                    x[3 * n + axis] = coordinate
                    u[3 * n + axis] = _normalised(coordinate, box, axis)


def walk(
    marked: MarchBits,
    *grids: Sequence[Tensor],
    read: int,
    activation: Activation,
    step: float,
    transmittance_bound: float,
) -> Walked:
    """Density at the samples of a march up to where a ray is opaque.

    Args:
        marked: the samples, as `gridreg.ops.cpu.march.mark` returns them.
        grids: three planes, unless the grid is a CP grid, and three lines.
        read: number of channels to use.
        activation: from features to densities.
        step: length of a sample's interval, world units.
        transmittance_bound: samples behind a smaller transmittance are dropped.
    """
    planar, lines = len(grids) > 1, grids[-1]
    rays, samples = len(marked.offsets) - 1, int(marked.offsets[-1])
    tasks, box = -(-rays // _RAYS) if samples else 0, activation.bounds.contiguous()
    density, counts = torch.empty(samples), torch.zeros(rays, dtype=torch.int64)
    limit = -math.log(transmittance_bound) if transmittance_bound > 0 else math.inf
    # A CP grid gives its lines once more in place of planes, which are not read then.
    launch(
        _vm_walk if planar else _cp_walk, tasks, *marked, box, density, *grids[0], *lines, read,
        float(activation.shift), float(activation.scale), float(step), limit, counts,
    )  # fmt: skip
    seen = torch.zeros_like(marked.offsets)
    torch.cumsum(counts, 0, out=seen[1:])
    kept = int(seen[-1])
    found = (
        torch.empty(kept, dtype=torch.int64),
        torch.empty(kept),
        torch.empty(kept, 3),
        torch.empty(kept, 3),
        torch.empty(kept),
    )
    launch(_write, tasks if kept else 0, *marked, seen, box, density, float(step), *found)
    return Walked(seen, *found)
