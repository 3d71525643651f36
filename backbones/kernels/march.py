"""Compiled ray march: the samples of `gridreg.rendering.plain.march`, bit for bit, without visiting empty
space."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from numba import njit, prange
from torch import Tensor

from gridreg.rendering.plain import CELL_TOLERANCE, steps_bound

__all__ = ["march"]

Array = npt.NDArray[Any]

# Edge, in cells, of the blocks that are skipped whole when nothing in them is occupied.
_COARSE = np.uint32(4)
_TOLERANCE = np.float32(CELL_TOLERANCE)
# Relative rounding of a position computed in float32 by a handful of operations, with room to spare.
_ROUNDING = np.float32(2e-6)
_ONE = np.uint64(1)


@njit(parallel=True, cache=True)
def _coarsen(cells: Array, coarse: Array) -> None:
    """Mark the blocks of ``_COARSE^3`` cells in which any cell is occupied."""
    nx, ny, nz = cells.shape
    for a in prange(coarse.shape[0]):
        column = np.empty(nz, np.uint8)
        for b in range(coarse.shape[1]):
            column[:] = 0
            for i in range(a * _COARSE, min(nx, (a + 1) * _COARSE)):
                for j in range(b * _COARSE, min(ny, (b + 1) * _COARSE)):
                    for k in range(nz):
                        column[k] |= cells[i, j, k]
            for c in range(coarse.shape[2]):
                occupied = False
                for k in range(c * _COARSE, min(nz, (c + 1) * _COARSE)):
                    occupied |= column[k] != 0
                coarse[a, b, c] = occupied


@njit(cache=True)
def _slab(origin: Any, direction: Any, far: Any, lower: Any, scale: Any, edge: Any) -> tuple[Any, Any, Any]:
    """Of one axis: which face of a cell the ray leaves by, and a distance before it as ``(i - at) * rate``.

    Along the ray the cell coordinate is ``start + t * speed`` up to ``slack`` cells of rounding.
    """
    start = (origin - lower) * scale
    speed = direction * scale
    slack = _ROUNDING * (scale * (abs(origin) + abs(lower) + abs(far * direction)) + edge)
    if speed > 0:
        return np.float32(1), start + slack, np.float32(1) / speed
    if speed < 0:
        return np.float32(0), start - slack, np.float32(1) / speed
    return np.float32(0), np.float32(-1), np.float32(np.inf)


# No fastmath here: contracted or reordered arithmetic would move samples across cell faces.
@njit(parallel=True, cache=True)
def _mark(
    origins: Array,
    directions: Array,
    t_min: Array,
    t_max: Array,
    step: Any,
    cells: Array,
    coarse: Array,
    lower: Array,
    scale: Array,
    jitter: Array,
    bits: Array,
    counts: Array,
) -> None:
    """Set the bit of every kept lattice index of every ray; counts how many."""
    nx, ny, nz = cells.shape
    sx, sy, sz = scale[0], scale[1], scale[2]
    lx, ly, lz = lower[0], lower[1], lower[2]
    edge_x, edge_y, edge_z = np.float32(nx), np.float32(ny), np.float32(nz)
    limit_x, limit_y, limit_z = edge_x + _TOLERANCE, edge_y + _TOLERANCE, edge_z + _TOLERANCE
    steps = bits.shape[1] * 64
    per_step = 1 / np.float64(step)
    zero = np.float32(0)
    one = np.float32(1)
    for ray in prange(origins.shape[0]):
        ox, oy, oz = origins[ray, 0], origins[ray, 1], origins[ray, 2]
        dx, dy, dz = directions[ray, 0], directions[ray, 1], directions[ray, 2]
        near, far, shift = t_min[ray], t_max[ray], jitter[ray]
        face_x, at_x, rate_x = _slab(ox, dx, far, lx, sx, edge_x)
        face_y, at_y, rate_y = _slab(oy, dy, far, ly, sy, edge_y)
        face_z, at_z, rate_z = _slab(oz, dz, far, lz, sz, edge_z)
        count = 0
        index = 0
        while index < steps:
            t = near + (np.float32(index) + shift) * step
            if not t < far:
                break
            x, y, z = ((ox + t * dx) - lx) * sx, ((oy + t * dy) - ly) * sy, ((oz + t * dz) - lz) * sz
            index += 1
            below = (x < -_TOLERANCE) | (y < -_TOLERANCE) | (z < -_TOLERANCE)
            if below | (not ((x <= limit_x) & (y <= limit_y) & (z <= limit_z))):
                continue
            # Unsigned, so that indexing has no branch for negative numbers.
            i = np.uint32(min(max(x, zero), edge_x - one))
            j = np.uint32(min(max(y, zero), edge_y - one))
            k = np.uint32(min(max(z, zero), edge_z - one))
            if cells[i, j, k]:
                bits[ray, (index - 1) >> 6] |= _ONE << np.uint64((index - 1) & 63)
                count += 1
                continue
            size = one
            if not coarse[i // _COARSE, j // _COARSE, k // _COARSE]:
                size = np.float32(_COARSE)
                i, j, k = i // _COARSE * _COARSE, j // _COARSE * _COARSE, k // _COARSE * _COARSE
            leave = (np.float32(i) + face_x * size - at_x) * rate_x
            leave = min(leave, (np.float32(j) + face_y * size - at_y) * rate_y)
            leave = min(leave, (np.float32(k) + face_z * size - at_z) * rate_z)
            last = (np.float64(leave) - near) * per_step - shift
            if last >= index:
                index = int(min(last, np.float64(steps))) + 1
        counts[ray] = count


@njit(parallel=True, cache=True)
def _fill(
    origins: Array,
    directions: Array,
    t_min: Array,
    step: Any,
    jitter: Array,
    bits: Array,
    offsets: Array,
    index: Array,
    ts: Array,
    positions: Array,
) -> None:
    """Write out the marked samples."""
    for ray in prange(origins.shape[0]):
        n = offsets[ray]
        end = offsets[ray + 1]
        word = 0
        while n < end:
            rest = bits[ray, word]
            i = word * 64
            while rest != 0:
                if rest & _ONE:
                    t = t_min[ray] + (np.float32(i) + jitter[ray]) * step
                    index[n] = i
                    ts[n] = t
                    for axis in range(3):
                        positions[n, axis] = origins[ray, axis] + t * directions[ray, axis]
                    n += 1
                rest >>= _ONE
                i += 1
            word += 1


@torch.no_grad()
def march(
    origins: Tensor,
    directions: Tensor,
    t_min: Tensor,
    t_max: Tensor,
    step: float,
    cells: Tensor,
    bounds: Tensor,
    jitter: Tensor | float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `gridreg.rendering.backends.march`; CPU float32 tensors.

    Empty cells, and whole empty blocks of cells, are left by the step after the ray's exit from them
    (Amanatides and Woo 1987), so the cost follows the number of cells that a ray meets near surfaces; samples
    stay on the lattice.
    """
    rays = origins.shape[0]
    steps = steps_bound(t_min, t_max, step)
    if steps == 0:
        offsets, empty = torch.zeros(rays + 1, dtype=torch.int64), torch.zeros(0)
        return offsets, offsets[:0].clone(), empty, empty.reshape(0, 3)
    o, d = origins.contiguous().numpy(), directions.contiguous().numpy()
    near, far = t_min.contiguous().numpy(), t_max.contiguous().numpy()
    shift = torch.as_tensor(jitter, dtype=torch.float32).expand(rays).contiguous().numpy()
    grid = cells.contiguous().view(torch.uint8).numpy()
    lower = bounds[0].contiguous().numpy()
    scale = (torch.tensor(cells.shape).float() / (bounds[1] - bounds[0])).numpy()
    coarse = np.empty([(n + int(_COARSE) - 1) // int(_COARSE) for n in grid.shape], np.uint8)
    bits = np.zeros((rays, (steps + 63) // 64), np.uint64)
    counts = np.empty(rays, np.int64)
    length = np.float32(step)

    _coarsen(grid, coarse)
    _mark(o, d, near, far, length, grid, coarse, lower, scale, shift, bits, counts)
    offsets = torch.zeros(rays + 1, dtype=torch.int64)
    torch.cumsum(torch.from_numpy(counts), 0, out=offsets[1:])
    samples = int(offsets[-1])
    index, t, positions = (
        torch.empty(samples, dtype=torch.int64),
        torch.empty(samples),
        torch.empty(samples, 3),
    )
    _fill(o, d, near, length, shift, bits, offsets.numpy(), index.numpy(), t.numpy(), positions.numpy())
    return offsets, index, t, positions
