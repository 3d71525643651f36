"""Masks over the levels of a multi-resolution grid, and over the bands of a direction encoding."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE, Place, within
from gridreg.base import Context, register
from gridreg.errors import InputError
from gridreg.regularizers import mask_functions as masks
from gridreg.regularizers.mask_base import Mask
from gridreg.schedules import Linear, Numeric, check_until, end_step


@register
@dataclass(frozen=True)
class LevelMask(Mask):
    """Levels of a multi-resolution grid open one after the other, coarse first.

    Level l is open if l < start + floor((t - begin) / every).

    Args:
        site: where it acts; its octaves are the levels, or else groups of `features` channels.
        start: levels open from the beginning.
        every: iterations between two levels: fraction of the run (float) or number of steps (int).
        begin: fraction of the run (float) or step (int) at which opening begins.
        features: channels per level.
        detach: closed channels keep their values and only lose their gradient.

    Formula: level l open if ``l < start + int((t - begin) / every)``
    Unit: none
    Source: Neuralangelo (Li et al., CVPR 2023), section 3.2: 4 levels, one more every 5,000 of 500,000 steps.
    """

    start: Numeric = 4
    every: Numeric = 0.01
    begin: Numeric = 0
    features: int = 2
    ranges = within(start=(1.0, float("inf")))
    counts = (("features", "channels per level, an int above 0"),)
    example_arguments = (
        {"start": 1, "every": 3, "features": 1},
        {"start": 2, "every": 0.05, "begin": 0.1, "features": 1},
        {"start": 1, "every": 0.2, "features": 1, "detach": True},
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        check_until(self.every, "every")
        if self.begin != 0:
            check_until(self.begin, "begin")

    def ranks(self, place: Place) -> tuple[int, ...]:
        """Level of each channel."""
        if place.octaves is not None:
            return super().ranks(place)
        channels = place.channels or 0
        if channels % self.features:
            raise InputError(f"features={self.features}: {channels} channels are no whole number of levels")
        return tuple(channel // self.features for channel in range(channels))

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over levels."""
        begin = 0 if self.begin == 0 else context.end(self.begin)
        start = self.now("start", context)
        return masks.level_mask(count, context.step, start=start, begin=begin, every=context.end(self.every))

    def end(self, count: int, total_steps: int) -> int | None:
        """The step at which the last level opens."""
        if not all(isinstance(value, (int, float)) for value in (self.start, self.every, self.begin)):
            return None
        begin = 0 if self.begin == 0 else end_step(self.begin, 0, total_steps)
        missing = max(0, math.ceil(count - self.start))  # type: ignore[operator]
        return begin + missing * end_step(self.every, 0, total_steps)


@register
@dataclass(frozen=True)
class ViewDependenceMask(Mask):
    """Only the lowest bands of the direction's encoding stay open, or none at all.

    With few views, colour that may depend on the direction explains each view by itself.

    Args:
        site: coefficients of spherical harmonics, or a direction encoding. Its octaves are the bands, or else
            the degrees of spherical harmonics.
        bands: bands that stay open; 0 closes the site altogether. A schedule opens band after band.
        until: fraction of the run (float) or step (int) from which all is open; None: never.
        coefficients: coefficients per colour if channels go colour by colour; None: all channels are one
            colour's.
        detach: closed channels keep their values and only lose their gradient.

    Formula: spherical bands ``>= bands`` 0
    Unit: none
    Source: SANeRF drops bands from 2 on.
    """

    bands: Numeric = 2
    until: Numeric | None = None
    coefficients: int | None = None
    ranges = within(bands=NOT_NEGATIVE)
    counts = (("coefficients", "coefficients per colour, or None"),)
    example_arguments = (
        {"bands": 1},
        {"bands": 0},
        {"bands": 1, "until": 0.5},
        {"bands": Linear(1, 10), "detach": True},
    )

    def ranks(self, place: Place) -> tuple[int, ...]:
        """Band of each channel."""
        if place.octaves is not None:
            return super().ranks(place)
        return masks.spherical_bands(place.channels or 0, self.coefficients)

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over bands."""
        if self.until is not None and context.step >= context.end(self.until):
            return torch.ones(count)
        return (torch.arange(count) < math.floor(self.now("bands", context))).float()
