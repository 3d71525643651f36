"""Low-passes: the field sees its grids without their fine detail, which returns during training."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE, SiteLike, within
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError
from gridreg.regularizers.filters import Boundary, fourier_low_pass, gaussian_blur
from gridreg.regularizers.total_variation import NO_NEIGHBOURS
from gridreg.schedules import Linear, Numeric

_FOURIERF_KEEP = Linear(0.3, 1.0, until=2000)


def annealed_radius(
    step: float, end: float, *, start: float = 0.15, rounds: int = 30, rate: float = 0.2, floor: float = 0.0
) -> float:
    """Blur radius that shrinks by rounds: ``floor + start / 2^(rate * int(rounds * step / end))``.

    Args:
        step: current step, iterations.
        end: step from which the radius is `floor`, iterations. (With SANeRF's numbers the last round before
            still has 1/64 of the start, a third of a voxel at 128^3.)
        start: radius at step 0 above the floor, fraction of the grid's edge.
        rounds: number of rounds.
        rate: halvings per round.
        floor: radius at the end, fraction of the grid's edge.

    Returns:
        Radius as a fraction of the grid's edge. Source: SANeRF (Xiao et al. 2024).

    Example:
        >>> annealed_radius(0, 300), annealed_radius(50, 300), annealed_radius(300, 300)
        (0.15, 0.075, 0.0)
    """
    if step >= end:
        return floor
    return floor + start / 2 ** (rate * math.floor(rounds * step / end))


@dataclass(frozen=True)
class _GridFilter(Regularizer):
    """Base of both low-passes: they act on grids, by one number that is kept in the state."""

    acts_on: ClassVar[Literal["mask", "grids"]] = "grids"
    open_at: ClassVar[float] = 0.0

    def number(self, context: Context) -> float:
        """The number that the filter depends on at this step."""
        return 0.0

    def filtered(self, values: Tensor, axes: tuple[int, ...], number: float | Tensor) -> Tensor:
        """Values filtered along their spatial axes."""
        return values

    def prepare(self, context: Context) -> None:
        """Keep the number of this step."""
        if context.place is not None and not context.place.spatial:
            raise InputError(f"{context.place.name}: {NO_NEIGHBOURS}")
        number = torch.tensor(self.number(context), dtype=torch.float64)
        context.state.setdefault("number", number).copy_(number)

    def is_identity(self, context: Context) -> bool:
        """The number is that at which everything passes."""
        return float(context.state["number"]) == self.open_at

    def transform(self, value: Tensor, context: Context) -> Tensor:
        """The grid with what takes part, some channels or one grid of a stack, filtered."""
        place, number = context.place, context.state["number"]
        if place is None:
            return value
        item = place.selector.item
        chosen = [(place.dim, place.selected), (place.stack, None if item is None else (item,))]
        parts, indices = [value], []
        for axis, selected in chosen:
            if axis is not None and selected is not None:
                indices.append((axis, torch.tensor(selected, device=value.device)))
                parts.append(parts[-1].index_select(*indices[-1]))
        # While compiling as a tensor, so that the next step needs no new code.
        now = number if torch.compiler.is_compiling() else float(number)
        result = self.filtered(parts[-1], place.spatial, now)
        for part, (axis, index) in zip(parts[-2::-1], reversed(indices), strict=True):
            result = part.index_copy(axis, index, result)
        return result

    def value(self, context: Context) -> float:
        """The number now."""
        return self.number(context)


@register
@dataclass(frozen=True)
class FourierLowPass(_GridFilter):
    """The field sees the low frequencies of its grids, first few, at the end all: see `fourier_low_pass`.

    The parameters stay as they are, and frequencies that are filtered out get no gradient. The fraction is of
    the present spectrum, whatever size the grid has been resampled to.

    Args:
        site: its `grids` are filtered, each along its spatial axes: lines, planes or voxels.
        keep: fraction of the spectrum that stays, in [0, 1]. FourieRF: from 0.3 to 1 in 2,000 steps on
            synthetic scenes, from 0.01 in 10,000 on real ones.
        boundary: "periodic" (Fourier) or "mirror" (cosine).

    Formula: ``g_hat(k) * clamp(keep * K - k + 1, 0, 1)`` for the frequencies k = 0..K of each axis
    Unit: fraction of the spectrum
    Source: FourieRF (Gomez et al. 2025)

    Raises:
        InputError: keep lies outside [0, 1], the boundary is unknown, or a grid has no spatial axes.

    Example:
        >>> FourierLowPass("density", keep=Linear(0.1, 1.0, until=0.3)).keep.at(300, 1000)
        1.0
    """

    site: SiteLike
    keep: Numeric = _FOURIERF_KEEP
    boundary: Boundary = "periodic"
    open_at = 1.0
    ranges = within(keep=(0.0, 1.0))
    example_arguments = (
        {"keep": Linear(0.1, 1.0, until=0.5)},
        {"keep": 0.4},
        {"keep": 0.0, "boundary": "mirror"},
    )

    def number(self, context: Context) -> float:
        """Fraction of the spectrum."""
        return self.now("keep", context)

    def filtered(self, values: Tensor, axes: tuple[int, ...], number: float | Tensor) -> Tensor:
        """Values without their high frequencies."""
        return fourier_low_pass(values, axes, number, self.boundary)


@register
@dataclass(frozen=True)
class GridBlur(_GridFilter):
    """The field sees its grids blurred, less and less: see `annealed_radius` and `gaussian_blur`.

    SANeRF widens the footprint of its samples on mip-mapped planes; for a field without mip-maps a blur of
    the grid does the same. The radius is a fraction of the grid's edge, so it survives resampling.

    Args:
        site: its `grids` are blurred, each along its spatial axes.
        until: fraction of the run (float) or step (int) from which the radius is `floor`.
        start: first radius (standard deviation), fraction of the grid's edge; SANeRF: 0.15.
        rounds: number of steps in which it shrinks; SANeRF: 30.
        rate: halvings per round; SANeRF: 0.2.
        floor: radius that stays, fraction of the grid's edge.

    Formula: Gaussian blur by ``floor + start / 2^(rate * int(rounds * t / T))``
    Unit: fraction of the grid's edge
    Source: SANeRF (Xiao et al. 2024)

    Raises:
        InputError: a number is out of range, or a grid has no spatial axes.
    """

    site: SiteLike
    until: Numeric = 0.3
    start: Numeric = 0.15
    rounds: Numeric = 30
    rate: Numeric = 0.2
    floor: Numeric = 0.0
    ranges = dict.fromkeys(("until", "start", "rounds", "rate", "floor"), NOT_NEGATIVE)
    example_arguments = ({"until": 0.5}, {"until": 3, "floor": 0.05})

    def number(self, context: Context) -> float:
        """Radius, fraction of the grid's edge."""
        now = {name: self.now(name, context) for name in ("start", "rate", "floor")}
        rounds = int(self.now("rounds", context))
        return annealed_radius(context.step, context.end(self.until), rounds=rounds, **now)

    def filtered(self, values: Tensor, axes: tuple[int, ...], number: float | Tensor) -> Tensor:
        """Blurred values."""
        return gaussian_blur(values, axes, number)
