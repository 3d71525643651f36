"""Compiled ray march: the samples of the plain `gridreg.ops.march`, bit for bit, without visiting empty space."""

from __future__ import annotations

import threading
import weakref
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from gridreg.ops import ray_marching as ops
from gridreg.ops.cpu.jit.compiler import exact, inline, kernel
from gridreg.ops.cpu.jit.launch import launch
from gridreg.ops.cpu.jit.table import Cube, Matrix, Vector, float32, int64, uint8

_REST = np.int64(2**63 - 1)
# Edge, in cells, of the blocks that are skipped whole when nothing in them is occupied.
_COARSE = np.uint32(4)
_TOLERANCE = np.float32(ops.CELL_TOLERANCE)
# Relative rounding of a position computed in float32 by a handful of operations, with a margin.
_ROUNDING = np.float32(2e-6)
_ONE = np.int64(1)
_ZERO_F, _ONE_F = np.float32(0), np.float32(1)
_INFINITE = np.float32(np.inf)
# Rays of one task.
_RAYS = 32
_kept = threading.local()


class MarchBits(NamedTuple):
    """The samples of a march before they are written out.

    Args:
        origins, directions: ``(R, 3)``, contiguous.
        near, shift: ``(R,)``; sample ``index`` lies at ``near + (index + shift) * step``.
        bits: ``(R, words)`` int64; bit i of word w is set if index ``64 w + i`` is kept.
        offsets: ``(R + 1,)`` int64; the samples of ray r are ``offsets[r] : offsets[r + 1]``.
    """

    origins: Tensor
    directions: Tensor
    near: Tensor
    shift: Tensor
    bits: Tensor
    offsets: Tensor


@exact
def sample_at(o: Any, d: Any, axis: Any, distance: Any) -> Any:
    """Coordinate of a sample along an axis."""
    return o[axis] + distance * d[axis]


@exact
def distance_of(near: Any, shift: Any, step: Any, index: Any) -> Any:
    """Distance of sample ``index`` along its ray."""
    return near + (np.float32(index) + shift) * step


@inline
def next_bit(bits: Any, after: Any) -> Any:
    """The first index from ``after`` on whose bit is set; 64 for each word if there is none."""
    words = bits.shape[0]
    word = after >> 6
    rest = int64(0)
    if word < words:
        # The sign bit would be shifted in for ever.
        low = after & 63
        rest = bits[word] if low == 0 else (bits[word] >> low) & (_REST >> (low - 1))
    while rest == 0:
        word += 1
        if word >= words:
            return 64 * words
        after = 64 * word
        rest = bits[word]
    while rest & 1 == 0:
        rest = (rest >> 1) & _REST
        after += 1
    return after


@kernel
def _coarsen(a: int, cells: Cube[uint8], coarse: Cube[uint8], columns: Matrix[uint8]) -> None:
    """Mark the blocks of ``_COARSE^3`` cells in which any cell is occupied; a task is one slab of blocks."""
    nx, ny, nz = cells.shape
    column = columns[a]
    for b in range(coarse.shape[1]):
        for k in range(nz):
            column[k] = 0
        for i in range(a * _COARSE, min(nx, (a + 1) * _COARSE)):
            for j in range(b * _COARSE, min(ny, (b + 1) * _COARSE)):
                row = cells[i, j]
                for k in range(nz):
                    column[k] |= row[k]
        for c in range(coarse.shape[2]):
            occupied = False
            for k in range(c * _COARSE, min(nz, (c + 1) * _COARSE)):
                occupied |= column[k] != 0
            coarse[a, b, c] = occupied


@exact
def _slab(origin: Any, direction: Any, far: Any, lower: Any, scale: Any, edge: Any) -> tuple[Any, Any, Any]:
    """For one axis: the face of a cell that the ray leaves by, and a distance before it as ``(i - at) * rate``.

    Along the ray the cell coordinate is ``start + t * speed`` up to ``slack`` cells of rounding.
    """
    start = (origin - lower) * scale
    speed = direction * scale
    slack = _ROUNDING * (scale * (abs(origin) + abs(lower) + abs(far * direction)) + edge)
    if speed > 0:
        return _ONE_F, start + slack, _ONE_F / speed
    if speed < 0:
        return _ZERO_F, start - slack, _ONE_F / speed
    return _ZERO_F, -_ONE_F, _INFINITE


# `exact`, as contracted or reordered arithmetic would move samples across cell faces.
@exact
def _mark_ray(
    o: Any, d: Any, near: Any, far: Any, shift: Any, step: Any, cells: Any, coarse: Any, box: Any, bits: Any,
) -> int:  # fmt: skip
    """Set the bits of the kept lattice indices of one ray and return their number."""
    nx, ny, nz = cells.shape
    edge_x, edge_y, edge_z = np.float32(nx), np.float32(ny), np.float32(nz)
    limit_x, limit_y, limit_z = edge_x + _TOLERANCE, edge_y + _TOLERANCE, edge_z + _TOLERANCE
    ox, oy, oz = o[0], o[1], o[2]
    dx, dy, dz = d[0], d[1], d[2]
    lx, ly, lz = box[0, 0], box[0, 1], box[0, 2]
    sx, sy, sz = box[1, 0], box[1, 1], box[1, 2]
    face_x, at_x, rate_x = _slab(ox, dx, far, lx, sx, edge_x)
    face_y, at_y, rate_y = _slab(oy, dy, far, ly, sy, edge_y)
    face_z, at_z, rate_z = _slab(oz, dz, far, lz, sz, edge_z)
    steps = bits.shape[0] * 64
    per_step = 1 / np.float64(step)
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
        i = np.uint32(min(max(x, _ZERO_F), edge_x - _ONE_F))
        j = np.uint32(min(max(y, _ZERO_F), edge_y - _ONE_F))
        k = np.uint32(min(max(z, _ZERO_F), edge_z - _ONE_F))
        # The coarse blocks first: they stay in the first-level cache.
        if coarse[i // _COARSE, j // _COARSE, k // _COARSE]:
            if cells[i, j, k]:
                bits[(index - 1) >> 6] |= _ONE << ((index - 1) & 63)
                count += 1
                continue
            size = _ONE_F
        else:
            size = np.float32(_COARSE)
            i, j, k = i // _COARSE * _COARSE, j // _COARSE * _COARSE, k // _COARSE * _COARSE
        leave = (np.float32(i) + face_x * size - at_x) * rate_x
        leave = min(leave, (np.float32(j) + face_y * size - at_y) * rate_y)
        leave = min(leave, (np.float32(k) + face_z * size - at_z) * rate_z)
        last = (np.float64(leave) - near) * per_step - shift
        if last >= index:
            index = int(min(last, np.float64(steps))) + 1
    return count


@kernel
def _mark(
    task: int, o: Matrix[float32], d: Matrix[float32], near: Vector[float32], far: Vector[float32],
    shift: Vector[float32], step: float32, cells: Cube[uint8], coarse: Cube[uint8], box: Matrix[float32],
    bits: Matrix[int64], counts: Vector[int64],
) -> None:  # fmt: skip
    """Find the samples of blocks of rays: bits of their lattice indices, and their counts."""
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, o.shape[0])):
        counts[ray] = _mark_ray(
            o[ray], d[ray], near[ray], far[ray], shift[ray], step, cells, coarse, box, bits[ray]
        )


@kernel
def _fill(
    task: int, o: Matrix[float32], d: Matrix[float32], near: Vector[float32], shift: Vector[float32],
    step: float32, bits: Matrix[int64], offsets: Vector[int64], index: Vector[int64], t: Vector[float32],
    x: Matrix[float32],
) -> None:  # fmt: skip
    """Write out the samples whose bits are set, of blocks of rays."""
    for ray in range(task * _RAYS, min((task + 1) * _RAYS, o.shape[0])):
        i = int64(-1)
        for n in range(offsets[ray], offsets[ray + 1]):
            i = next_bit(bits[ray], i + 1)
            index[n], t[n] = i, distance_of(near[ray], shift[ray], step, i)
            for axis in range(3):
                x[n, axis] = sample_at(o[ray], d[ray], axis, t[n])


class _Blocks(NamedTuple):
    """Owner of the blocks, version of the cells, and the blocks."""

    of: weakref.ref[Tensor]
    version: int | None
    coarse: Tensor


def _coarse(cells: Tensor, grid: Tensor) -> Tensor:
    """Blocks of cells that hold an occupied one; kept for the thread's next march through the same cells."""
    version = None if cells.is_inference() else cells._version
    kept: _Blocks | None = getattr(_kept, "blocks", None)
    if kept is not None and version is not None and kept.of() is cells and kept.version == version:
        return kept.coarse
    coarse = torch.empty(*(-(-n // int(_COARSE)) for n in grid.shape), dtype=torch.uint8)
    launch(
        _coarsen, coarse.shape[0], grid, coarse, torch.empty(len(coarse), grid.shape[2], dtype=torch.uint8)
    )
    _kept.blocks = _Blocks(weakref.ref(cells), version, coarse)
    return coarse


@torch.no_grad()
def mark(arguments: ops.MarchArguments) -> MarchBits:
    """Find the samples of a march."""
    origins, directions, t_min, t_max, step, cells, bounds, jitter = arguments
    rays = origins.shape[0]
    steps = ops.steps_bound(t_min, t_max, step)
    o, d, near, far = (x.contiguous() for x in (origins, directions, t_min, t_max))
    shift = torch.as_tensor(jitter, dtype=torch.float32).expand(rays).contiguous()
    grid = cells.contiguous().view(torch.uint8)
    shape = torch.tensor(grid.shape)
    box = torch.stack([bounds[0], shape.to(bounds.dtype) / (bounds[1] - bounds[0])])
    coarse = _coarse(cells, grid)
    bits, counts = torch.zeros(rays, -(-steps // 64), dtype=torch.int64), torch.zeros(rays, dtype=torch.int64)
    tasks = -(-rays // _RAYS)

    launch(_mark, tasks if steps else 0, o, d, near, far, shift, step, grid, coarse, box, bits, counts)
    offsets = torch.zeros(rays + 1, dtype=torch.int64)
    torch.cumsum(counts, 0, out=offsets[1:])
    return MarchBits(o, d, near, shift, bits, offsets)


@ops.march.register_cpu()
@torch.no_grad()
def march(arguments: ops.MarchArguments) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `gridreg.ops.march`.

    Empty cells, and whole empty blocks of cells, are left by the step after the ray's exit from them
    (Amanatides and Woo 1987), so the cost follows the number of cells that a ray meets near surfaces; samples
    stay on the lattice.
    """
    o, d, near, shift, bits, offsets = mark(arguments)
    samples = int(offsets[-1])
    index, t, positions = (
        torch.empty(samples, dtype=torch.int64),
        torch.empty(samples),
        torch.empty(samples, 3),
    )
    launch(
        _fill,
        -(-o.shape[0] // _RAYS) if samples else 0,
        o,
        d,
        near,
        shift,
        arguments.step,
        bits,
        offsets,
        index,
        t,
        positions,
    )
    return offsets, index, t, positions
