"""Plain PyTorch versions of the inner loops for any device and float dtype; `backends` documents them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops.pooling import pool_faint

__all__ = [
    "CELL_TOLERANCE",
    "accumulate",
    "check_march",
    "check_packed",
    "composite_weights",
    "march",
    "terminate",
]

# In cells: entry points computed by a box intersection may fall outside the box by their rounding.
CELL_TOLERANCE = 1e-3
# Elements of a (rays, steps) block: bounds the temporary memory to some tens of megabytes.
_BLOCK = 1 << 20


def check_march(
    origins: Tensor,
    directions: Tensor,
    t_min: Tensor,
    t_max: Tensor,
    step: float,
    cells: Tensor,
    bounds: Tensor,
    jitter: Tensor | float,
) -> None:
    """Raise `InputError` unless the arguments of `march` fit each other."""
    rays = origins.shape[0]
    for name, tensor, shape in (
        ("origins", origins, (rays, 3)),
        ("directions", directions, (rays, 3)),
        ("t_min", t_min, (rays,)),
        ("t_max", t_max, (rays,)),
        ("bounds", bounds, (2, 3)),
        ("jitter", jitter, (rays,)),
    ):
        if isinstance(tensor, Tensor) and tuple(tensor.shape) != shape:
            raise InputError(f"{name}: found shape {tuple(tensor.shape)}, expected {shape}")
    if cells.dim() != 3 or cells.numel() == 0 or cells.dtype not in (torch.uint8, torch.bool):
        raise InputError(
            f"cells: found {cells.dtype} of shape {tuple(cells.shape)}, expected (X, Y, Z) uint8 or bool"
        )
    if not (step > 0 and math.isfinite(step)):
        raise InputError(f"step: found {step}, expected a positive length")


def check_packed(values: Tensor, offsets: Tensor, name: str) -> None:
    """Raise `InputError` unless ``values`` is ``(N,)`` and ``offsets`` ``(R + 1,)`` int64 that ends at N."""
    if values.dim() != 1:
        raise InputError(f"{name}: found shape {tuple(values.shape)}, expected (N,)")
    if offsets.dim() != 1 or offsets.numel() == 0 or offsets.dtype != torch.int64:
        raise InputError(
            f"offsets: found {offsets.dtype} of shape {tuple(offsets.shape)}, expected (R + 1,) int64"
        )
    if offsets.device.type == "cpu" and int(offsets[-1]) != values.shape[0]:
        raise InputError(
            f"offsets: found the end {int(offsets[-1])}, expected {values.shape[0]}, the length of {name}"
        )


def steps_bound(t_min: Tensor, t_max: Tensor, step: float) -> int:
    """Upper bound of the number of lattice steps of any ray.

    Raises:
        InputError: if a range is infinite, or has more steps than float32 can count.
    """
    if t_min.numel() == 0:
        return 0
    longest = float((t_max - t_min).nan_to_num(nan=0.0).max())
    if not longest / step < 2**23:
        raise InputError(f"t_max - t_min: found {longest}, expected at most {2**23} steps of {step}")
    return math.ceil(longest / step) + 1 if longest > 0 else 0


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
    """See `gridreg.ops.rays.march`."""
    rays, device, dtype = origins.shape[0], origins.device, origins.dtype
    # 0-dim tensors of the rays' dtype: Python numbers would take part in double precision on some devices.
    length = torch.tensor(step, dtype=dtype, device=device)
    shift = torch.as_tensor(jitter, dtype=dtype, device=device).expand(rays)
    shape = torch.tensor(cells.shape, device=device)
    scale = shape.to(dtype) / (bounds[1] - bounds[0])
    limit = shape.to(dtype) + torch.tensor(CELL_TOLERANCE, dtype=dtype, device=device)
    flat = cells.reshape(-1) != 0
    steps = steps_bound(t_min, t_max, step)
    lattice = torch.arange(steps, dtype=dtype, device=device)
    block = max(1, _BLOCK // max(1, steps))

    counts = [torch.zeros(1, dtype=torch.int64, device=device)]
    kept: list[tuple[Tensor, Tensor, Tensor]] = []
    for first in range(0, rays if steps else 0, block):
        part = slice(first, first + block)
        t = t_min[part, None] + (lattice + shift[part, None]) * length
        positions = origins[part, None] + t[..., None] * directions[part, None]
        cell = (positions - bounds[0]) * scale
        inside = ((cell >= -CELL_TOLERANCE) & (cell <= limit)).all(-1) & (t < t_max[part, None])
        ray, index = inside.nonzero(as_tuple=True)
        i, j, k = cell[ray, index].floor().long().clamp_(min=0).minimum(shape - 1).unbind(-1)
        occupied = flat[(i * cells.shape[1] + j) * cells.shape[2] + k]
        ray, index = ray[occupied], index[occupied]
        counts.append(torch.bincount(ray, minlength=t.shape[0]))
        kept.append((index, t[ray, index], positions[ray, index]))
    if not kept:
        empty = torch.zeros(0, dtype=dtype, device=device)
        offsets = torch.zeros(rays + 1, dtype=torch.int64, device=device)
        return offsets, offsets[:0].clone(), empty, empty.reshape(0, 3)
    index, t, positions = (torch.cat(column) for column in zip(*kept, strict=True))
    return torch.cat(counts).cumsum(0), index, t, positions


def _ray_of_sample(offsets: Tensor, samples: int) -> Tensor:
    rays = torch.arange(offsets.numel() - 1, device=offsets.device)
    return rays.repeat_interleave(offsets.diff(), output_size=samples)


def _blocks(offsets: Tensor) -> Iterator[tuple[slice, Tensor]]:
    """Groups of whole rays whose padded rectangle is small: their samples, and offsets that start at 0."""
    longest = int(offsets.diff().max()) if offsets.numel() > 1 else 0
    block = max(1, _BLOCK // max(1, longest))
    for first in range(0, offsets.numel() - 1, block):
        part = offsets[first : first + block + 1]
        yield slice(int(part[0]), int(part[-1])), part - part[0]


def _depth_before(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """Optical depth that lies in front of every sample, ``(N,)``.

    A padded rectangle, as the rounding of one running sum over all rays would grow with the number of rays.
    """
    # Above this exp(-tau) is 0 in float64, and inf * 0 in a derivative would be NaN.
    finite = optical_depth.clamp(max=1e3)
    parts = [finite[:0]]
    for samples, part in _blocks(offsets):
        tau = finite[samples]
        ray = _ray_of_sample(part, tau.numel())
        place = torch.arange(tau.numel(), device=tau.device) - part[ray]
        longest = int(part.diff().max())
        padded = tau.new_zeros(part.numel() - 1, longest + 1).index_put((ray, place + 1), tau)
        parts.append(padded.cumsum(1)[ray, place])
    return torch.cat(parts)


def composite_weights(optical_depth: Tensor, offsets: Tensor) -> Tensor:
    """See `gridreg.ops.rays.composite_weights`."""
    return torch.exp(-_depth_before(optical_depth, offsets)) * -torch.expm1(-optical_depth)


def accumulate(weights: Tensor, values: Tensor, offsets: Tensor) -> Tensor:
    """See `gridreg.ops.rays.accumulate`."""
    ray = _ray_of_sample(offsets, weights.numel())
    sums = values.new_zeros(offsets.numel() - 1, values.shape[1])
    return sums.index_add(0, ray, weights[:, None] * values)


def pixels(
    weights: Tensor, colours: Tensor, t: Tensor, background: Tensor, offsets: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """See `gridreg.ops.rays.pixels`."""
    stacked = torch.cat([colours, t[:, None], torch.ones_like(t[:, None])], dim=-1)
    total = accumulate(weights, stacked, offsets)
    opacity = total[:, 4]
    return total[:, :3] + (1 - opacity)[:, None] * background, opacity, total[:, 3]


@torch.no_grad()
def terminate(optical_depth: Tensor, offsets: Tensor, bound: float) -> Tensor:
    """See `gridreg.ops.rays.terminate`."""
    return torch.exp(-_depth_before(optical_depth, offsets)) >= bound


@torch.no_grad()
def pool(
    weights: Tensor, offsets: Tensor, floor: float, bound: float, generator: torch.Generator | None
) -> tuple[Tensor, Tensor, Tensor]:
    """See `gridreg.ops.rays.pool`."""
    chosen = (weights > floor).nonzero().squeeze(-1)
    rays = _ray_of_sample(offsets, weights.numel())[chosen]
    speakers = members = torch.arange(len(chosen), device=chosen.device)
    if bound > floor:
        speakers, members = pool_faint(weights[chosen], rays, bound, generator)
    pools = torch.full_like(weights, -1, dtype=torch.int64)
    pools[chosen] = members
    return chosen[speakers], rays[speakers], pools


def spread(colours: Tensor, pools: Tensor, speakers: Tensor) -> Tensor:
    """See `gridreg.ops.rays.spread`."""
    # The last row is that of samples in no pool.
    return torch.cat([colours, colours.new_zeros(1, colours.shape[1])])[pools]
