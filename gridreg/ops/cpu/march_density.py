"""Density along rays with early termination: samples that cannot be seen are hardly ever computed.

A task marches along some rays from sample to sample, and leaves a ray where its transmittance falls below a bound.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gridreg.ops.cpu.cp import product_sum, segments_of
from gridreg.ops.cpu.grid_coordinates import BATCH, COORDINATES, locate
from gridreg.ops.cpu.jit.compiler import exact, inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.simd import LANES, load, store, vector_zero
from gridreg.ops.cpu.jit.simd_math import softplus
from gridreg.ops.cpu.jit.table import Cube, Matrix, Vector, float32, int32, int64, scratch
from gridreg.ops.cpu.march import MarchBits, distance_of, next_bit, sample_at
from gridreg.ops.cpu.vm import Batch, find_cells, look_up, shape_of
from gridreg.ops.ray_marching import Activation, RayMarchResult

# Samples between two looks at the transmittance: so many may be computed in vain behind the last one.
_GROUP = LANES
# Samples placed on the grid at a time, of which most may be in vain.
_SPAN = 64
_POSITIONS = 3 * _SPAN
# Rays of a task.
_RAYS = 16


class _Density(NamedTuple):
    """From features to what a ray has passed: density ``scale * softplus(feature + shift)``, and the bound."""

    box: Any
    shift: Any
    scale: Any
    step: Any
    limit: Any


# Rounded as the plain version does it, so that both agree on what is inside.
@exact
def _normalised(x: float32, box: Vector[float32], axis: int) -> Any:
    return (x - box[axis]) / (box[3 + axis] - box[axis])


@inline
def _outside(u: Vector[float32], n: int) -> bool:
    x, y, z = u[3 * n], u[3 * n + 1], u[3 * n + 2]
    zero, one = float32(0), float32(1)
    return (x < zero) | (x > one) | (y < zero) | (y > one) | (z < zero) | (z > one)  # type: ignore[no-any-return]


@inline
def _place(rays: Any, ray: int, i: int, count: int, density_of: Any, u: Vector[float32]) -> int:
    """Find the next samples of a ray behind index ``i``, normalise them to u, and return the last one's index."""
    o, d, bits = rays.origins[ray], rays.directions[ray], rays.bits[ray]
    for q in range(count):
        i = next_bit(bits, i + 1)
        distance = distance_of(rays.near[ray], rays.shift[ray], density_of.step, i)
        for axis in range(3):
            u[3 * q + axis] = _normalised(sample_at(o, d, axis, distance), density_of.box, axis)
    return i


@inline
def _march_ray(
    rays: Any, ray: int, planes: Any, lines: Any, read: int, density_of: Any, u: Any, samples: Any, features: Any,
    density: Any, planar: bool,
) -> Any:  # fmt: skip
    """Fill density of the samples of a ray until it is opaque, and return how many can be seen."""
    begin, end = rays.offsets[ray], rays.offsets[ray + 1]
    channels, shape, step = lines[0].shape[1], shape_of(lines), density_of.step
    nodes, fractions, cells = samples.nodes, samples.fractions, samples.cells
    depth, index = float32(0), int64(-1)
    for first in range(begin, end, _SPAN):
        count = min(int64(_SPAN), end - first)
        index = _place(rays, ray, index, count, density_of, u)
        locate(nodes, fractions, u, 0, count, shape)
        if planar:
            find_cells(samples, count, shape, channels)
        for start in range(0, count, _GROUP):
            stop = min(start + _GROUP, count)
            if planar:
                part = start, stop, count
                look_up(planes[0], lines[0], 0, nodes, fractions, cells, part, read, features, 0, True)
                look_up(planes[1], lines[1], 1, nodes, fractions, cells, part, read, features, 0, True)
                look_up(planes[2], lines[2], 2, nodes, fractions, cells, part, read, features, 0, True)
            else:
                for q in range(start, stop):
                    segments = segments_of(nodes, fractions, q, channels)
                    features[q] = product_sum((lines[2], lines[1], lines[0]), segments, read)
            # The last group of a ray is filled up with leftovers.
            values = (
                softplus(load(features, start, vector_zero()) + density_of.shift, vector_zero())
                * density_of.scale
            )
            store(features, start, values)
            for q in range(start, stop):
                if depth > density_of.limit:
                    return first + q - begin
                value = float32(0) if _outside(u, q) else features[q]
                density[first + q] = value
                depth += value * step
    return end - begin


@kernel
def _march_vm(
    task: int, origins: Matrix[float32], directions: Matrix[float32], near: Vector[float32], shift: Vector[float32],
    bits: Matrix[int64], offsets: Vector[int64], xy: Cube[float32], xz: Cube[float32], yz: Cube[float32],
    z: Matrix[float32], y: Matrix[float32], x: Matrix[float32], read: int64, box: Vector[float32],
    feature_shift: float32, scale: float32, step: float32, limit: float32, density: Vector[float32],
    counts: Vector[int64],
) -> None:  # fmt: skip
    """Density of a VM grid at the samples of some rays, and how many of them can be seen."""
    u, features = scratch(_POSITIONS, float32), scratch(BATCH, float32)
    samples = Batch(scratch(COORDINATES, int32), scratch(COORDINATES, float32), scratch(COORDINATES, int32))
    rays = MarchBits(origins, directions, near, shift, bits, offsets)  # type: ignore[arg-type]
    density_of = _Density(box, feature_shift, scale, step, limit)
    planes, lines = (xy, xz, yz), (z, y, x)
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, counts.shape[0])):
        counts[ray] = _march_ray(
            rays, ray, planes, lines, read, density_of, u, samples, features, density, True
        )


@kernel
def _march_cp(
    task: int, origins: Matrix[float32], directions: Matrix[float32], near: Vector[float32], shift: Vector[float32],
    bits: Matrix[int64], offsets: Vector[int64], z: Matrix[float32], y: Matrix[float32], x: Matrix[float32],
    read: int64, box: Vector[float32], feature_shift: float32, scale: float32, step: float32, limit: float32,
    density: Vector[float32], counts: Vector[int64],
) -> None:  # fmt: skip
    """Density of a CP grid at the samples of some rays, and how many of them can be seen."""
    u, features = scratch(_POSITIONS, float32), scratch(BATCH, float32)
    samples = Batch(scratch(COORDINATES, int32), scratch(COORDINATES, float32), scratch(COORDINATES, int32))
    rays = MarchBits(origins, directions, near, shift, bits, offsets)  # type: ignore[arg-type]
    density_of = _Density(box, feature_shift, scale, step, limit)
    lines = (z, y, x)
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, counts.shape[0])):
        # Lines stand in for the planes, which are not read.
        counts[ray] = _march_ray(
            rays, ray, lines, lines, read, density_of, u, samples, features, density, False
        )


@kernel
def _write(
    task: int, origins: Matrix[float32], directions: Matrix[float32], near: Vector[float32], shift: Vector[float32],
    bits: Matrix[int64], old: Vector[int64], density: Vector[float32], box: Vector[float32], step: float32,
    new: Vector[int64], index: Vector[int64], t: Vector[float32], positions: Vector[float32],
    kept: Vector[float32], u: Vector[float32],
) -> None:  # fmt: skip
    """Write out the samples that can be seen; ``old`` and ``new`` are offsets before and after."""
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, old.shape[0] - 1)):
        start, i = old[ray] - new[ray], int64(-1)
        for n in range(new[ray], new[ray + 1]):
            i = next_bit(bits[ray], i + 1)
            distance = distance_of(near[ray], shift[ray], step, i)
            index[n], t[n], kept[n] = i, distance, density[n + start]
            for axis in range(3):
                coordinate = sample_at(origins[ray], directions[ray], axis, distance)
                positions[3 * n + axis] = coordinate
                u[3 * n + axis] = _normalised(coordinate, box, axis)


def march_density(
    candidates: MarchBits,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    *,
    read: int,
    activation: Activation,
    step: float,
    transmittance_bound: float,
) -> tuple[RayMarchResult, Tensor]:
    """Density at the samples of a march up to where a ray is opaque, not differentiable.

    Args:
        candidates: the samples, as `gridreg.ops.cpu.march.mark` returns them.
        planes: three, or none for a CP grid.
        lines: three.
        read: number of channels to use.
        activation: from features to densities.
        step: length of a sample's interval, world units.
        transmittance_bound: samples behind a smaller transmittance are dropped.

    Returns:
        The samples that can be seen, and their positions normalised to the box ``(N, 3)``.
    """
    rays, samples = len(candidates.offsets) - 1, int(candidates.offsets[-1])
    tasks, box = -(-rays // _RAYS) if samples else 0, activation.bounds.contiguous()
    density, counts = torch.empty(samples), torch.zeros(rays, dtype=torch.int64)
    limit = -math.log(transmittance_bound) if transmittance_bound > 0 else math.inf
    launch(
        _march_vm if planes else _march_cp, tasks, *candidates, *planes, *lines, read, box, float(activation.shift),
        float(activation.scale), float(step), limit, density, counts,
    )  # fmt: skip
    offsets = torch.zeros_like(candidates.offsets)
    torch.cumsum(counts, 0, out=offsets[1:])
    count = int(offsets[-1])
    index, t, positions = torch.empty(count, dtype=torch.int64), torch.empty(count), torch.empty(count, 3)
    kept, u = torch.empty(count), torch.empty(count, 3)
    found = (offsets, index, t, positions, kept)
    launch(_write, tasks if count else 0, *candidates, density, box, float(step), *found, u)
    return RayMarchResult(*found), u
