"""Lookups in VM grids: three planes times three lines (TensoRF, Chen et al. 2022, equations 3 and 10)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gridreg.ops.dispatch import operation
from gridreg.ops.interpolation import (
    LINE_AXES,
    PLANE_AXES,
    check_grids,
    close_channels,
    interpolate_line,
    interpolate_plane,
)
from gridreg.ops.ray_marching import (
    Activation,
    MarchArguments,
    RayMarchResult,
    check_march_density,
    march_density,
)


def _products(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None
) -> list[Tensor]:
    return [
        close_channels(
            interpolate_plane(plane, u[:, a], u[:, b]) * interpolate_line(line, u[:, v]), open_channels
        )
        for plane, line, (a, b), v in zip(planes, lines, PLANE_AXES, LINE_AXES, strict=True)
    ]


def _check(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
    dtype: torch.dtype = torch.float32,
) -> None:
    check_grids(u, planes, lines, open_channels)


@operation(check=_check)
def vm_density(
    u: Tensor, planes: Sequence[Tensor], lines: Sequence[Tensor], open_channels: int | None = None
) -> Tensor:
    """Sum over planes and channels of plane times line.

    Args:
        u: ``(N, 3)`` in [0, 1]^3, clamped to it. If it requires a gradient, the plain version runs.
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
    return torch.stack([p.sum(1) for p in _products(u, planes, lines, open_channels)]).sum(0)


@operation(check=_check)
def vm_features(
    u: Tensor,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
    dtype: torch.dtype = torch.float32,
) -> Tensor:
    """Products of planes and lines, concatenated: ``(N, 3 C)``. Arguments as for `vm_density`.

    Args:
        dtype: of the result: float32, or bfloat16 for a network that rounds it so in any case. Sums are float32.
    """
    found = torch.cat(_products(u, planes, lines, open_channels), dim=1)
    return found if dtype == torch.float32 else found.to(dtype)


def _check_march(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> None:
    check_grids(march.origins, planes, lines, open_channels)
    check_march_density(march, activation, transmittance_bound)


@operation(check=_check_march)
def vm_march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    planes: Sequence[Tensor],
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> RayMarchResult:
    """March through an occupancy grid, evaluate the density, and leave a ray where nothing behind can be seen.

    The same as `gridreg.ops.march_density` with the field's density.

    Args:
        march: rays, step and cells, and the box that the cells divide.
        activation: from features to densities, and the field's box, to which positions are normalised.
        transmittance_bound: samples behind a smaller transmittance are dropped; 0 keeps all.
        planes, lines, open_channels: as for `vm_density`.

    Returns:
        The samples kept; their density is differentiable in planes and lines.

    Raises:
        InputError: if shapes do not fit or a number is out of range.
    """

    def density(positions: Tensor) -> Tensor:
        return activation.density(lambda u: vm_density.reference(u, planes, lines, open_channels), positions)

    return march_density(march, density, transmittance_bound)
