"""Penalties on the values of a site's raw grids: mean absolute value, mean square, orthogonality of lines."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gridreg.attach.sites import Grid, SiteLike
from gridreg.base import Context, LocalTerm, Regularizer, register
from gridreg.regularizers.total_variation import spatial_axes
from gridreg.schedules import Numeric


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


def l2(values: Tensor) -> Tensor:
    """Mean square of a grid; arguments as in `l1`.

    Returns:
        Scalar, squared unit of the values. Source: ridge regression (Hoerl and Kennard 1970).

    Example:
        >>> l2(torch.tensor([-1.0, 3.0])).item()
        5.0
    """
    return values.square().mean() if values.numel() else values.sum()


class _Orthogonality(Function):
    """In one piece, as lines are so small that what counts is the number of operations."""

    @staticmethod
    def forward(ctx: Any, lines: Tensor) -> Tensor:
        """Mean absolute value of the products off the diagonal, for lines ``(R, M)``."""
        products = (lines @ lines.T).fill_diagonal_(0)
        ctx.save_for_backward(lines, products)
        return products.abs().sum() / (len(lines) * (len(lines) - 1))

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, upstream: Tensor) -> Tensor:
        """Each line's gradient: the others, with the signs of the products."""
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
class L1(Regularizer):
    """Values of the site's grids are drawn to 0: see `l1`.

    Args:
        site: its `grids` are penalised; TensoRF: the density's.
        weight: factor of the loss; TensoRF: 8e-5, from the first occupancy mask on 4e-5; on CP lines 1e-5.

    Formula: ``sum over grids of mean(abs(g))``
    Unit: unit of the grid
    Source: TensoRF (Chen et al. 2022), sparsity loss

    Example:
        >>> from gridreg.schedules import Piecewise
        >>> L1("density", weight=Piecewise(values=(8e-5, 4e-5), steps=(2000,))).weight.at(2000, 15_000)
        4e-05
    """

    site: SiteLike
    weight: Numeric = 8e-5
    example_arguments = ({},)

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`l1`, added over the grids."""
        return torch.stack([l1(grid.values) for grid in grids]).sum()

    def local_terms(self, grids: Sequence[Grid], context: Context) -> list[LocalTerm]:
        """One for each grid, if all of it takes part."""
        return _terms("l1", grids)


@register
@dataclass(frozen=True)
class L2(Regularizer):
    """Values of the site's grids are drawn to 0, large ones most: see `l2`.

    Apart from `WeightDecay`, which leaves the gradient alone, it goes through the optimizer: Adam divides it by the
    root of the mean square as it does the gradient of the images.

    Args:
        site: its `grids` are penalised.
        weight: factor of the loss.

    Formula: ``sum over grids of mean(g^2)``
    Unit: squared unit of the grid
    Source: ridge regression (Hoerl and Kennard 1970)
    """

    site: SiteLike
    weight: Numeric = 1e-4
    example_arguments = ({},)

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`l2`, added over the grids."""
        return torch.stack([l2(grid.values) for grid in grids]).sum()

    def local_terms(self, grids: Sequence[Grid], context: Context) -> list[LocalTerm]:
        """One for each grid, if all of it takes part."""
        return _terms("l2", grids)


def _terms(kind: Literal["l1", "l2"], grids: Sequence[Grid]) -> list[LocalTerm]:
    """Closed forms of the grids, if all of each takes part."""
    whole = all(grid.whole for grid in grids)
    return [LocalTerm(kind, 1.0, grid.parameter, grid.spatial) for grid in grids] if whole else []


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
    """

    site: SiteLike
    weight: Numeric = 0.01
    example_arguments = ({},)

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`orthogonality`, added over the lines."""
        # A table has no neighbours, but a row for each channel all the same.
        tabled = [replace(g, spatial=g.spatial or _others(g, (g.dim,))) for g in grids]
        lines = [grid for grid in tabled if len(spatial_axes(grid, "Orthogonality")) == 1]
        rows = [row for grid in lines or tabled for row in _rows(grid)]
        return torch.stack([orthogonality(row) for row in rows]).sum()
