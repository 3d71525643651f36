"""Lookups in CP grids: three lines multiplied together (TensoRF, Chen et al. 2022, section 3)."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from gridreg.ops.dispatch import operation
from gridreg.ops.interpolation import LINE_AXES, check_grids, close_channels, interpolate_line
from gridreg.ops.ray_marching import (
    Activation,
    MarchArguments,
    RayMarchResult,
    check_march_density,
    march_density,
)


def _check(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> None:
    check_grids(u, (), lines, open_channels)


@operation(check=_check)
def cp_features(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """Products of three lines, ``(N, C)``. Arguments as for `gridreg.ops.vm_density`."""
    first, second, third = (
        interpolate_line(line, u[:, axis]) for line, axis in zip(lines, LINE_AXES, strict=True)
    )
    return close_channels(first * second * third, open_channels)


@operation(check=_check)
def cp_density(u: Tensor, lines: Sequence[Tensor], open_channels: int | None = None) -> Tensor:
    """Sum over channels of the product of three lines, ``(N,)``. Arguments as for `gridreg.ops.vm_density`."""
    return cp_features.reference(u, lines, open_channels).sum(1)


def _check_march(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> None:
    check_grids(march.origins, (), lines, open_channels)
    check_march_density(march, activation, transmittance_bound)


@operation(check=_check_march)
def cp_march_density(
    march: MarchArguments,
    activation: Activation,
    transmittance_bound: float,
    lines: Sequence[Tensor],
    open_channels: int | None = None,
) -> RayMarchResult:
    """`gridreg.ops.vm_march_density` for the lines of a CP grid."""

    def density(positions: Tensor) -> Tensor:
        return activation.density(lambda u: cp_density.reference(u, lines, open_channels), positions)

    return march_density(march, density, transmittance_bound)
