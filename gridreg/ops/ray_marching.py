"""Ray marching through an occupancy grid: samples in occupied cells, their density, early ray termination."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.errors import InputError
from gridreg.ops.composite import terminate
from gridreg.ops.dispatch import operation

# In cells: entry points computed by a box intersection may fall outside the box by their rounding.
CELL_TOLERANCE = 1e-3
# Elements of a (rays, steps) block: bounds the temporary memory to some tens of megabytes.
_BLOCK = 1 << 20


class MarchArguments(NamedTuple):
    """Rays, the lattice of samples on them, and the cells that they pass.

    Args:
        origins, directions: ``(R, 3)``, world units; directions have length 1.
        t_min, t_max: ``(R,)`` entry and exit distance; a ray with ``t_min >= t_max`` has no samples.
        step: distance between samples, world units.
        cells: ``(X, Y, Z)`` uint8 or bool occupancy, nonzero = occupied.
        bounds: ``(2, 3)`` corners of the box that ``cells`` divides.
        jitter: in [0, 1): ``(R,)`` or one number; 0.5 for rendering.
    """

    origins: Tensor
    directions: Tensor
    t_min: Tensor
    t_max: Tensor
    step: float
    cells: Tensor
    bounds: Tensor
    jitter: Tensor | float


def check_march(arguments: MarchArguments) -> None:
    """Raise `InputError` unless the arguments of `march` fit each other."""
    rays = arguments.origins.shape[0]
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("origins", "directions"), (rays, 3))
    shapes |= {"bounds": (2, 3), "t_min": (rays,), "t_max": (rays,), "jitter": (rays,)}
    for name, shape in shapes.items():
        found = getattr(arguments, name)
        if isinstance(found, Tensor) and tuple(found.shape) != shape:
            raise InputError(f"{name}: found shape {tuple(found.shape)}, expected {shape}")
    cells, step = arguments.cells, arguments.step
    if cells.dim() != 3 or cells.numel() == 0 or cells.dtype not in (torch.uint8, torch.bool):
        raise InputError(
            f"cells: found {cells.dtype} of shape {tuple(cells.shape)}, expected (X, Y, Z) uint8 or bool"
        )
    if not (step > 0 and math.isfinite(step)):
        raise InputError(f"step: found {step}, expected a positive length")


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


@operation(check=check_march)
@torch.no_grad()
def march(arguments: MarchArguments) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Sample rays at a fixed step, keeping the samples that lie in occupied cells.

    Sample ``index`` of a ray lies at ``t = t_min + (index + jitter) * step`` and is kept when ``t < t_max``
    and the cell ``floor(u * cells.shape)`` of its position is occupied, ``u`` the position normalised to
    ``bounds``. Positions outside ``bounds`` are in no cell; within a thousandth of a cell of a face they
    count as inside. Every operation is rounded to the rays' dtype in the order of the formula, so that all
    versions keep exactly the same samples.

    Returns:
        ``offsets (R + 1,)`` int64, ``index (N,)`` int64, ``t (N,)`` and ``positions (N, 3)``; the samples of
        ray r are ``offsets[r] : offsets[r + 1]`` in increasing ``t``. Not differentiable.

    Raises:
        InputError: for shapes that do not fit, a step that is not positive, or an infinite range.

    Example:
        >>> o, d = torch.zeros(1, 3), torch.tensor([[1.0, 0.0, 0.0]])
        >>> cells = torch.tensor([0, 1], dtype=torch.uint8).reshape(2, 1, 1)
        >>> bounds = torch.tensor([[0.0, -1.0, -1.0], [4.0, 1.0, 1.0]])
        >>> rays = MarchArguments(o, d, torch.zeros(1), torch.full((1,), 4.0), 1.0, cells, bounds, 0.5)
        >>> offsets, index, t, _ = march(rays)
        >>> offsets.tolist(), index.tolist(), t.tolist()
        ([0, 2], [2, 3], [2.5, 3.5])
    """
    origins, directions, t_min, t_max, step, cells, bounds, jitter = arguments
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


class Activation(NamedTuple):
    """``density = scale * softplus(feature + shift)`` inside a box, 0 outside.

    Args:
        bounds: ``(2, 3)`` corners of the box, world units.
        shift: added to features.
        scale: per world unit.
    """

    bounds: Tensor
    shift: float
    scale: float

    def density(self, features: Callable[[Tensor], Tensor], positions: Tensor) -> Tensor:
        """Density ``(N,)`` at world positions ``(N, 3)``; ``features`` maps positions normalised to [0, 1]^3."""
        lower, upper = self.bounds
        u = (positions - lower) / (upper - lower)
        inside = ((u >= 0) & (u <= 1)).all(dim=1)
        density = self.scale * F.softplus(features(u) + self.shift)
        return torch.where(inside, density, torch.zeros_like(density))


class RayMarchResult(NamedTuple):
    """The samples that a march kept, packed by ray, and their density.

    Args:
        offsets: ``(R + 1,)`` int64.
        index: ``(N,)`` int64, number of the sample on its ray, skipped ones included.
        t: ``(N,)`` distance along the ray, world units.
        positions: ``(N, 3)``, world units.
        density: ``(N,)`` per world unit.
        delta: ``(N,)`` length of the sample's interval, world units; None: one step.
        ray_steps: ``(R,)`` int64, samples of each ray, skipped ones included; None: as the step says, or with
            ``delta`` up to the last one kept.
        features: ``(N, F)`` for the field's ``colour_of_features``, or None.
    """

    offsets: Tensor
    index: Tensor  # type: ignore[assignment]
    t: Tensor
    positions: Tensor
    density: Tensor
    delta: Tensor | None = None
    ray_steps: Tensor | None = None
    features: Tensor | None = None


def check_march_density(arguments: MarchArguments, activation: Activation, bound: float) -> None:
    """Raise `InputError` unless rays, activation and the bound on the transmittance are in range."""
    check_march(arguments)
    if tuple(activation.bounds.shape) != (2, 3):
        raise InputError(f"activation.bounds: found shape {tuple(activation.bounds.shape)}, expected (2, 3)")
    if not activation.scale > 0:
        raise InputError(f"activation.scale: found {activation.scale}, expected a positive number")
    if not 0 <= bound <= 1:
        raise InputError(f"transmittance_bound: found {bound}, expected a number in [0, 1]")


def march_density(
    arguments: MarchArguments, density: Callable[[Tensor], Tensor], transmittance_bound: float
) -> RayMarchResult:
    """March through an occupancy grid, evaluate the density, and leave a ray where nothing behind can be seen.

    Args:
        arguments: rays, step and cells.
        density: world positions ``(N, 3)`` to densities ``(N,)`` per world unit.
        transmittance_bound: samples behind a smaller transmittance are dropped; 0 keeps all.

    Returns:
        The samples kept; their density is differentiable as ``density`` is.
    """
    offsets, index, t, positions = march(arguments)
    values = density(positions)
    if transmittance_bound > 0:
        seen = terminate(values.detach() * arguments.step, offsets, transmittance_bound)
        offsets = F.pad(seen.cumsum(0), (1, 0))[offsets]
        index, t, positions, values = index[seen], t[seen], positions[seen], values[seen]
    return RayMarchResult(offsets, index, t, positions, values)
