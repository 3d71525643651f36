"""Chooses the compiled or the plain version of a lookup, after checking its arguments."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gridreg.errors import InputError
from gridreg.ops import grid_reference as reference
from gridreg.ops import ray_reference as plain
from gridreg.ops.arguments import Activation, MarchArguments
from gridreg.ops.cpu import autograd
from gridreg.ops.rays import chosen_backend

__all__ = [
    "Activation",
    "MarchArguments",
    "cp_density",
    "cp_features",
    "cp_march_density",
    "vm_density",
    "vm_features",
    "vm_march_density",
]


def _check(u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None) -> None:
    if u.dim() != 2 or u.shape[1] != 3:
        raise InputError(f"u: found shape {tuple(u.shape)}, expected (N, 3)")
    if len(lines) != 3 or lines[0].dim() != 2:
        raise InputError(f"lines: found shapes {[tuple(x.shape) for x in lines]}, expected three (M, C)")
    edges, channels = [lines[2 - axis].shape[0] for axis in range(3)], lines[0].shape[1]
    expected: dict[str, list[tuple[int, ...]]] = {
        "lines": [(edges[axis], channels) for axis in reference.LINE_AXES]
    }
    if min(edges) < 2:
        raise InputError(f"lines: found {edges} nodes along x, y, z, expected at least 2")
    if planes:
        expected["planes"] = [(edges[a], edges[b], channels) for a, b in reference.PLANE_AXES]
    for name, grids in (("lines", lines), ("planes", planes)):
        shapes = [tuple(x.shape) for x in grids]
        if shapes != expected.get(name, []):
            raise InputError(f"{name}: found shapes {shapes}, expected {expected.get(name, [])}")
    if open_channels is not None and open_channels < 0:
        raise InputError(f"open_channels: found {open_channels}, expected None or a number from 0 on")


def _takes_compiled(*tensors: Tensor) -> bool:
    if chosen_backend() == "torch" or tensors[0].requires_grad:
        return False
    # Compiled code counts the elements of a grid in 32 bits.
    return all(x.device.type == "cpu" and x.dtype == torch.float32 and x.numel() < 2**31 for x in tensors)


def _count(lines: Sequence[Tensor], open_channels: int | None) -> int:
    channels = lines[0].shape[-1]
    return channels if open_channels is None else min(channels, open_channels)


def vm_density(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    """Sum over planes and channels of plane times line (TensoRF, Chen et al. 2022, equation 10).

    Args:
        u: ``(N, 3)`` in [0, 1]^3, clamped to it. If it requires a gradient, the plain path is taken.
        planes: three, ``(A, B, C)``, along axes (0, 1), (0, 2), (1, 2); ``C`` the same for all.
        lines: three, ``(M, C)``, along axes 2, 1, 0. Nodes of an edge of n lie at ``i / (n - 1)``.
        open_channels: channels at and beyond this index count as 0, are not read and get no gradient.

    Returns:
        ``(N,)``, differentiable in planes and lines.

    Raises:
        InputError: if shapes do not fit.

    Example:
        >>> grids = [torch.ones(2, 2, 4)] * 3, [torch.full((2, 4), 0.5)] * 3
        >>> vm_density(torch.rand(2, 3), *grids).tolist(), vm_density(torch.rand(1, 3), *grids, 1).tolist()
        ([6.0, 6.0], [1.5])
    """
    _check(u, planes, lines, open_channels)
    if _takes_compiled(u, *planes, *lines):
        return autograd.vm_density(u, planes, lines, _count(lines, open_channels))
    return reference.vm_density(u, planes, lines, open_channels)


def vm_features(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Products of planes and lines, concatenated: ``(N, 3 C)``. Arguments as for `vm_density`.

    Args:
        dtype: of the result: float32, or bfloat16 for products that round it so in any case. Sums are float32.
    """
    _check(u, planes, lines, open_channels)
    if _takes_compiled(u, *planes, *lines):
        return autograd.vm_features(u, planes, lines, _count(lines, open_channels), dtype)
    found = reference.vm_features(u, planes, lines, open_channels)
    return found if dtype == torch.float32 else found.to(dtype)


def cp_density(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """Sum over channels of the product of three lines, ``(N,)``. Arguments as for `vm_density`."""
    _check(u, (), lines, open_channels)
    if _takes_compiled(u, *lines):
        return autograd.cp_density(u, lines, _count(lines, open_channels))
    return reference.cp_density(u, lines, open_channels)


def cp_features(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """Products of three lines, ``(N, C)``. Arguments as for `vm_density`."""
    _check(u, (), lines, open_channels)
    if _takes_compiled(u, *lines):
        return autograd.cp_features(u, lines, _count(lines, open_channels))
    return reference.cp_features(u, lines, open_channels)


def _check_march(march: MarchArguments, activation: Activation, transmittance_bound: float) -> None:
    plain.check_march(*march)
    if tuple(activation.bounds.shape) != (2, 3):
        raise InputError(f"activation.bounds: found shape {tuple(activation.bounds.shape)}, expected (2, 3)")
    if not activation.scale > 0:
        raise InputError(f"activation.scale: found {activation.scale}, expected a positive number")
    if not 0 <= transmittance_bound <= 1:
        raise InputError(f"transmittance_bound: found {transmittance_bound}, expected a number in [0, 1]")


def vm_march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """March through an occupancy grid, evaluate the density, and leave a ray where nothing behind can be seen.

    The same as `gridreg.ops.rays.march`, the density of a field at each sample, and
    `gridreg.ops.rays.terminate`; compiled, samples that are dropped are hardly ever computed.

    Args:
        march: rays, step and cells, and the box that the cells divide.
        activation: from features to densities, and the field's box, to which positions are normalised.
        transmittance_bound: samples behind a smaller transmittance are dropped; 0 keeps all.
        planes, lines, open_channels: as for `vm_density`.

    Returns:
        ``offsets (R + 1,)`` int64, ``index (N,)`` int64, ``t (N,)``, ``positions (N, 3)`` and ``density (N,)`` of the
        samples kept; the last is differentiable in planes and lines.

    Raises:
        InputError: if shapes do not fit or a number is out of range.
    """
    _check(march.origins, planes, lines, open_channels)
    _check_march(march, activation, transmittance_bound)
    if _takes_compiled(*_tensors(march, activation), *planes, *lines):
        opened = _count(lines, open_channels)
        return autograd.march_density(march, activation, transmittance_bound, planes, lines, opened)
    return reference.march_density(
        march,
        activation,
        transmittance_bound,
        lambda u: reference.vm_density(u, planes, lines, open_channels),
    )


def cp_march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`vm_march_density` for the lines of a CP grid."""
    _check(march.origins, (), lines, open_channels)
    _check_march(march, activation, transmittance_bound)
    if _takes_compiled(*_tensors(march, activation), *lines):
        opened = _count(lines, open_channels)
        return autograd.march_density(march, activation, transmittance_bound, (), lines, opened)
    return reference.march_density(
        march, activation, transmittance_bound, lambda u: reference.cp_density(u, lines, open_channels)
    )


def _tensors(march: MarchArguments, activation: Activation) -> list[Tensor]:
    jitter = [march.jitter] if isinstance(march.jitter, Tensor) else []
    return [
        march.origins,
        march.directions,
        march.t_min,
        march.t_max,
        march.bounds,
        activation.bounds,
        *jitter,
    ]
