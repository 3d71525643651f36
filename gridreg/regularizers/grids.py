"""Penalties on the raw grids of a site: total variation, mean absolute value, orthogonality of lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.attach.sites import Grid, SiteLike
from gridreg.base import Context, LocalTerm, Regularizer, check_site, check_weight, register
from gridreg.errors import InputError
from gridreg.schedules import Linear, Numeric

__all__ = ["NO_NEIGHBOURS", "L1", "Orthogonality", "TotalVariation", "l1", "orthogonality", "total_variation"]

NO_NEIGHBOURS = (
    "has no spatial axis longer than 1 (in a table, cells side by side need not be neighbours in space); "
    "name its axes with spatial=..."
)


def total_variation(values: Tensor, axes: Sequence[int]) -> Tensor:
    """Sum over axes of the mean squared difference of neighbours along the axis.

    ``sum_a mean((v[i + 1] - v[i])^2 along a)``; an axis of length 1 has no neighbours and adds nothing.

    Args:
        values: a grid, any shape.
        axes: its spatial axes.

    Returns:
        Scalar, squared unit of the values. Source: TensoRF (Chen et al. 2022), total variation loss; its
        program's `TVLoss` is twice this, for each plane.

    Example:
        >>> total_variation(torch.tensor([[0.0, 1.0], [0.0, 1.0]]), axes=(0, 1)).item()
        1.0
    """
    total = values.new_zeros(())
    for axis in axes:
        if values.shape[axis] > 1 and values.numel():
            total = total + values.diff(dim=axis).square().mean()
    return total


def l1(values: Tensor) -> Tensor:
    """Mean absolute value of a grid.

    Args:
        values: any shape.

    Returns:
        Scalar, unit of the values. Source: TensoRF (Chen et al. 2022), sparsity loss.

    Example:
        >>> l1(torch.tensor([-1.0, 3.0])).item()
        2.0
    """
    return values.abs().mean() if values.numel() else values.sum()


class _Orthogonality(Function):
    """In one piece, as lines are so small that what counts is the number of operations."""

    @staticmethod
    def forward(ctx: Any, lines: Tensor) -> Tensor:
        products = (lines @ lines.T).fill_diagonal_(0)
        ctx.save_for_backward(lines, products)
        return products.abs().sum() / (len(lines) * (len(lines) - 1))

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        lines, products = ctx.saved_tensors
        gradient: Tensor = (products.sign() @ lines) * (2 * upstream / (len(lines) * (len(lines) - 1)))
        return gradient


def orthogonality(lines: Tensor) -> Tensor:
    """Mean absolute value of what lies off the diagonal of ``V V^T``: channels should not repeat each other.

    Args:
        lines: ``(R, M)``, one row for each of `R` channels.

    Returns:
        Scalar; 0 for a single channel. Differentiable once. Source: TensoRF's program, `vectorDiffs`.

    Example:
        >>> orthogonality(torch.eye(3)).item(), orthogonality(torch.ones(2, 5)).item()
        (0.0, 5.0)
    """
    if lines.shape[0] < 2:
        return lines.sum() * 0
    value: Tensor = _Orthogonality.apply(lines)  # type: ignore[no-untyped-call]
    return value


def _spatial(grid: Grid, who: str) -> tuple[int, ...]:
    """Axes along which a grid has neighbours."""
    shape = tuple(grid.values.shape)
    axes = tuple(axis for axis in grid.spatial if shape[axis] > 1)
    if not axes:
        raise InputError(f"{who}: {grid.name} of shape {shape} {NO_NEIGHBOURS}")
    return axes


def _others(grid: Grid, axes: Sequence[int]) -> tuple[int, ...]:
    """Axes of a grid beside these."""
    return tuple(axis for axis in range(grid.values.ndim) if axis not in axes)


def _rows(grid: Grid) -> Sequence[Tensor]:
    """Channels as rows ``(channels, nodes)``, for each of the grids that lie along further axes."""
    values = grid.values
    stacked = _others(grid, (grid.dim, *grid.spatial))
    rows = values.permute(*stacked, grid.dim, *grid.spatial).flatten(len(stacked) + 1)
    return rows.flatten(0, len(stacked) - 1).unbind() if stacked else (rows,)


@register
@dataclass(frozen=True)
class TotalVariation(Regularizer):
    """Differences between neighbouring cells of the site's grids are penalised: see `total_variation`.

    Added over the grids of the site. TensoRF's `TV_weight_density` and `TV_weight_app` act on planes only,
    with factors 2 and 0.01 on top: its weight `w` is ``weight=0.02 * w`` on "density.planes" or
    "appearance.planes" here.

    Args:
        site: its `grids` are penalised.
        weight: factor of the loss; TensoRF: 0.1 to 1.0 (times 0.02), on CP lines 1e-3 (times 2).
        every: acts in every so many iterations, from the first on, and then so many times as strongly: the mean over
            iterations stays, and large grids are read less often. Where no other gradient is, Adam, which divides by
            the root of the mean square, takes smaller steps by about the root of ``every``.

    Formula: ``sum over grids and spatial axes of mean((g[i + 1] - g[i])^2)``
    Unit: squared unit of the grid
    Source: TensoRF (Chen et al. 2022), total variation loss

    Raises:
        InputError: the site, the weight or ``every`` is not one; a grid has no spatial axes.

    Example:
        >>> TotalVariation("density", weight=0.01).weight
        0.01
    """

    site: SiteLike
    weight: Numeric = 0.01
    every: int = 1

    def __post_init__(self) -> None:
        """Refuse at once what can be refused before the first step."""
        check_site(self.site)
        check_weight(self.weight)
        if isinstance(self.every, bool) or not isinstance(self.every, int) or self.every < 1:
            raise InputError(f"TotalVariation: found every={self.every!r}, expected an integer of at least 1")

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`total_variation`, added over the grids, times ``every``; 0 in the iterations between."""
        axes = [_spatial(g, "TotalVariation") for g in grids]
        if context.step % self.every:
            return grids[0].values.new_zeros(())
        parts = [total_variation(g.values, spatial) for g, spatial in zip(grids, axes, strict=True)]
        return torch.stack(parts).sum() * self.every

    def local_terms(self, grids: Sequence[Grid], context: Context) -> list[LocalTerm]:
        """One for each grid, if all channels take part; none in the iterations between."""
        if context.step % self.every or not all(grid.whole for grid in grids):
            return []
        return [
            LocalTerm("total_variation", self.every, g.parameter, _spatial(g, "TotalVariation"))
            for g in grids
        ]

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """With a number, with a schedule, and not in every iteration."""
        return [cls(site), cls(site, weight=Linear(0.0, 1.0)), cls(site, every=3)]


@register
@dataclass(frozen=True)
class L1(Regularizer):
    """Values of the site's grids are drawn to 0: see `l1`.

    Args:
        site: its `grids` are penalised; TensoRF: the density's.
        weight: factor of the loss; TensoRF: 8e-5, from the first occupancy mask on 4e-5; on CP lines 1e-5.

    Formula: ``sum over grids of mean(abs(g))``
    Unit: unit of the grid
    Source: TensoRF (Chen et al. 2022), sparsity loss

    Raises:
        InputError: the site or the weight is not one.

    Example:
        >>> from gridreg.schedules import Piecewise
        >>> L1("density", weight=Piecewise(values=(8e-5, 4e-5), steps=(2000,))).weight.at(2000, 15_000)
        4e-05
    """

    site: SiteLike
    weight: Numeric = 8e-5

    def __post_init__(self) -> None:
        """Refuse at once what can be refused before the first step."""
        check_site(self.site)
        check_weight(self.weight)

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`l1`, added over the grids."""
        return torch.stack([l1(grid.values) for grid in grids]).sum()

    def local_terms(self, grids: Sequence[Grid], context: Context) -> list[LocalTerm]:
        """One for each grid, if all channels take part."""
        if not all(grid.whole for grid in grids):
            return []
        return [LocalTerm("l1", 1.0, grid.parameter, grid.spatial) for grid in grids]

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """At its default."""
        return [cls(site)]


@register
@dataclass(frozen=True)
class Orthogonality(Regularizer):
    """Channels of the site's lines should not repeat each other: see `orthogonality`.

    Lines are the grids with one spatial axis. Planes and voxels beside them are left alone, as in TensoRF;
    at a site without lines they are taken themselves, each channel as one long row. Channels are compared
    within a grid: not along an axis that is neither the channels' nor spatial, on which several grids lie.

    Lines of zeros are orthogonal too. While a field has found no matter yet, the gradient of its images is
    weak, and this one can shrink all lines to nothing: let the weight start later (`Piecewise`).

    Args:
        site: the lines among its `grids` are penalised, or all of them if there are no lines.
        weight: factor of the loss; Few TensoRF: 0.01.

    Formula: ``sum over lines V (channels x nodes) of mean(abs(V V^T)) off the diagonal``
    Unit: squared unit of the grid, times nodes
    Source: TensoRF's program (`Ortho_weight`)

    Raises:
        InputError: the site or the weight is not one; a grid has no spatial axes.

    Example:
        >>> Orthogonality("density").weight
        0.01
    """

    site: SiteLike
    weight: Numeric = 0.01

    def __post_init__(self) -> None:
        """Refuse at once what can be refused before the first step."""
        check_site(self.site)
        check_weight(self.weight)

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`orthogonality`, added over the lines."""
        # A table has no neighbours, but a row for each channel all the same.
        tabled = [replace(g, spatial=g.spatial or _others(g, (g.dim,))) for g in grids]
        lines = [grid for grid in tabled if len(_spatial(grid, "Orthogonality")) == 1]
        rows = [row for grid in lines or tabled for row in _rows(grid)]
        return torch.stack([orthogonality(row) for row in rows]).sum()

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """At its default."""
        return [cls(site)]
