"""Penalties on the differences of neighbouring cells of a grid, in space and in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, TypeAlias

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.attach.sites import NOT_NEGATIVE, Grid, SiteLike, within
from gridreg.base import Context, LocalTerm, Regularizer, register
from gridreg.errors import InputError
from gridreg.schedules import Linear, Numeric

NO_NEIGHBOURS = (
    "has no spatial axis longer than 1 (in a table, cells side by side need not be neighbours in space); "
    "name its axes with spatial=..."
)

Form: TypeAlias = Literal["squared", "absolute", "huber"]


def total_variation(
    values: Tensor,
    axes: Sequence[int],
    form: Form = "squared",
    *,
    delta: float = 1.0,
    share: float = 1.0,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Sum over axes of the mean squared (absolute, or Huber's) difference of neighbours along the axis.

    ``sum_a mean(f(v[i + 1] - v[i]) along a)``; an axis of length 1 has no neighbours and adds nothing.

    Args:
        values: a grid, any shape.
        axes: its spatial axes.
        form: "squared", ``f(x) = x^2``; "absolute", ``|x|``; "huber", ``x^2 / 2`` up to `delta`, then
            ``delta (|x| - delta / 2)``.
        delta: where Huber's form goes over into a straight line, unit of the values.
        share: of the pairs along each axis that are looked at, drawn at random; in expectation all shares are equal.
        generator: source of the random numbers, on the CPU.

    Returns:
        Scalar, squared unit of the values (absolute: their unit). Source: TensoRF (Chen et al. 2022), total variation
        loss; its program's `TVLoss` is twice this, for each plane. Absolute: Rudin et al. 1992; Huber's: DVGO's
        program (delta 1); on random cells: Plenoxels (Yu et al. 2022).

    Example:
        >>> total_variation(torch.tensor([[0.0, 1.0], [0.0, 1.0]]), axes=(0, 1)).item()
        1.0
    """
    total = values.new_zeros(())
    for axis in axes:
        pairs = values.shape[axis] - 1
        if pairs < 1 or not values.numel():
            continue
        if share < 1:
            chosen = torch.randperm(pairs, generator=generator)[: max(1, round(share * pairs))].sort().values
            chosen = chosen.to(values.device)
            steps = values.index_select(axis, chosen + 1) - values.index_select(axis, chosen)
        else:
            steps = values.diff(dim=axis)
        if form == "huber":
            total = total + F.huber_loss(steps, torch.zeros_like(steps), delta=delta)
        else:
            total = total + (steps.square() if form == "squared" else steps.abs()).mean()
    return total


def time_smoothness(values: Tensor, axis: int) -> Tensor:
    """Mean squared second difference along time, ``mean((v[t - 1] - 2 v[t] + v[t + 1])^2)``; 0 up to two times.

    Args:
        values: a grid with an axis of time, any shape.
        axis: the axis of time.

    Returns:
        Scalar, squared unit of the values. Source: K-Planes (Fridovich-Keil et al. 2023), equation 6, smoothness in
        time, averaged as in its program.

    Example:
        >>> time_smoothness(torch.tensor([0.0, 1.0, 2.0, 4.0]), 0).item()
        0.5
    """
    if values.shape[axis] < 3 or not values.numel():
        return values.sum() * 0
    return values.diff(n=2, dim=axis).square().mean()


def spatial_axes(grid: Grid, who: str) -> tuple[int, ...]:
    """Axes along which a grid has neighbours.

    Raises:
        InputError: it has none, in the name of `who` asked.
    """
    shape = tuple(grid.values.shape)
    axes = tuple(axis for axis in grid.spatial if shape[axis] > 1)
    if not axes:
        raise InputError(f"{who}: {grid.name} of shape {shape} {NO_NEIGHBOURS}")
    return axes


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
        form: "squared"; "absolute" and "huber" leave steep edges be.
        delta: where Huber's form goes over into a straight line, unit of the grid.
        share: of the pairs along each axis, in (0, 1], drawn anew at each step; Plenoxels: 0.01 of the cells.

    Formula: ``sum over grids and spatial axes of mean(f(g[i + 1] - g[i]))``, ``f(x) = x^2``, ``|x|`` or Huber's
    Unit: squared unit of the grid (absolute: its unit)
    Source: TensoRF (Chen et al. 2022), total variation loss; absolute: Rudin et al. 1992; Huber's: DVGO's program;
    on random cells: Plenoxels (Yu et al. 2022)
    """

    site: SiteLike
    weight: Numeric = 0.01
    every: int = 1
    form: Form = "squared"
    delta: float = 1.0
    share: float = 1.0
    ranges = within(delta=NOT_NEGATIVE, share=(0.0, 1.0))
    example_arguments = (
        {},
        {"weight": Linear(0.0, 1.0)},
        {"every": 3},
        {"form": "huber", "delta": 0.1},
        {"form": "absolute", "share": 0.5},
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if isinstance(self.every, bool) or not isinstance(self.every, int) or self.every < 1:
            raise InputError(f"TotalVariation: found every={self.every!r}, expected an integer of at least 1")
        for name in self.ranges:
            if getattr(self, name) == 0:
                raise InputError(f"{name}=0: expected a number above 0")

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`total_variation`, added over the grids, times ``every``; 0 in the iterations between."""
        axes = [spatial_axes(g, "TotalVariation") for g in grids]
        if context.step % self.every:
            return grids[0].values.new_zeros(())
        parts = [
            total_variation(
                g.values,
                spatial,
                self.form,
                delta=self.delta,
                share=self.share,
                generator=context.step_generator() if self.share < 1 else None,
            )
            for g, spatial in zip(grids, axes, strict=True)
        ]
        return torch.stack(parts).sum() * self.every

    def local_terms(self, grids: Sequence[Grid], context: Context) -> list[LocalTerm]:
        """One for each grid, if all of it takes part in the squared form; none in the iterations between."""
        whole = self.form == "squared" and self.share == 1 and all(grid.whole for grid in grids)
        if context.step % self.every or not whole:
            return []
        return [
            LocalTerm("total_variation", self.every, g.parameter, spatial_axes(g, "TotalVariation"))
            for g in grids
        ]


@register
@dataclass(frozen=True)
class TimeSmoothness(Regularizer):
    """Values of a grid should change steadily in time: see `time_smoothness`.

    Added over the grids of the site. Unlike total variation along the axis of time it lets steady motion be.

    Args:
        site: its `grids` are penalised: the space-time planes.
        weight: factor of the loss; K-Planes: 0.1 on its dynamic scenes.
        axis: which of a grid's spatial axes is time: 0, the first, in K-Planes' planes ``(1, C, T, X)``.

    Formula: ``sum over grids of mean((g[t - 1] - 2 g[t] + g[t + 1])^2)``
    Unit: squared unit of the grid
    Source: K-Planes (Fridovich-Keil et al. 2023), equation 6, smoothness in time

    Raises:
        InputError: the site or the weight is not one; a grid has no such axis.
    """

    site: SiteLike
    weight: Numeric = 0.1
    axis: int = 0
    example_arguments = ({}, {"axis": -1})

    def grid_penalty(self, grids: Sequence[Grid], context: Context) -> Tensor:
        """`time_smoothness`, added over the grids."""
        for grid in grids:
            spatial_axes(grid, "TimeSmoothness")
            if not -len(grid.spatial) <= self.axis < len(grid.spatial):
                raise InputError(
                    f"axis={self.axis}: {grid.name} has {len(grid.spatial)} spatial axes, from 0; which one is time?"
                )
        return torch.stack([time_smoothness(g.values, g.spatial[self.axis]) for g in grids]).sum()
