"""Masks as regularizers: which channels of a site are open at which step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gridreg import masks
from gridreg.base import Context, Regularizer, register
from gridreg.channel_masks import Mask
from gridreg.errors import InputError
from gridreg.schedules import Linear, Numeric, Schedule, check_numeric, end_step
from gridreg.sites import Place, SiteLike

__all__ = ["CosineMask", "FixedMask", "FrequencyMask", "LevelMask", "ViewDependenceMask"]


@register
@dataclass(frozen=True)
class FrequencyMask(Mask):
    """FreeNeRF's frequency mask: channels open from low to high until all are open.

    Args:
        site: where it acts. Where the site knows octaves, whole octaves open, the identity first.
        until: fraction of the run (float) or step (int) from which all is open.
        block: ranks that open together, at most all; by default 3 channels, or 1 octave.
        variant: "block" (`gridreg.frequency_mask`), or, by channel index and for comparison only, "printed"
            (`gridreg.printed_frequency_mask`) and "authors" (`gridreg.authors_frequency_mask`).
        detach: closed channels keep their values and only lose their gradient.

    Source: FreeNeRF (Yang et al., CVPR 2023), section 3.3; on components of a grid: Few TensoRF.

    >>> FrequencyMask("density", until=0.9)
    FrequencyMask(site='density', detach=False, until=0.9, block=None, variant='block')
    """

    until: Numeric = 0.9
    block: int | None = None
    variant: Literal["block", "printed", "authors"] = "block"

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        super().__post_init__()
        check_until(self.until)
        if self.variant not in ("block", "printed", "authors"):
            raise InputError(f"variant={self.variant!r}: expected 'block', 'printed' or 'authors'")
        if self.block is not None and (isinstance(self.block, bool) or not self.block >= 1):
            raise InputError(f"block={self.block!r}: expected a number of channels, an int above 0, or None")

    def ranks(self, place: Place) -> tuple[int, ...]:
        """By octave where known; the variants know only the index."""
        if self.variant == "block":
            return super().ranks(place)
        return tuple(range(place.channels or 0))

    def mask(self, context: Context) -> Tensor:
        """The mask over the channels that take part, shape `(channels,)`."""
        place = context.place
        if self.variant == "block" and self.block is None and place is not None and place.octaves is None:
            # Fewer channels than a block count as one block.
            channels = place.channels or 1
            end = context.end(self.until)
            return masks.frequency_mask(channels, context.step, end, block=min(3, channels))
        return super().mask(context)

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over ranks."""
        end = context.end(self.until)
        if self.variant == "printed":
            return masks.printed_frequency_mask(count, context.step, end)
        if self.variant == "authors":
            return masks.authors_frequency_mask(count, context.step, end, block=min(self.block or 5, count))
        return masks.frequency_mask(count, context.step, end, block=min(self.block or 1, count))

    def end(self, count: int, total_steps: int) -> int | None:
        """The step that `until` stands for."""
        return _fixed_end(self.until, total_steps)

    def monotone(self) -> bool:
        """Not in the printed form."""
        return self.variant != "printed"

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """Instances for the contract suite."""
        return [
            cls(site, until=0.9),
            cls(site, until=7, block=2),
            cls(site, until=0.5, detach=True),
            cls(site, variant="authors"),
            cls(site, variant="printed"),
        ]


@register
@dataclass(frozen=True)
class FixedMask(Mask):
    """The lowest share of the channels (of the octaves, where known) stays open, the rest closed.

    Args:
        site: where it acts.
        visible_ratio: open share, in [0, 1]: the first `int(channels * visible_ratio)`.
        detach: closed channels keep their values and only lose their gradient.

    Source: Few TensoRF, human-body runs with 0.8.

    >>> FixedMask("appearance", visible_ratio=0.8).visible_ratio
    0.8
    """

    visible_ratio: Numeric = 0.8

    def __post_init__(self) -> None:
        """Refuse shares outside [0, 1]."""
        super().__post_init__()
        check_numeric("visible_ratio", self.visible_ratio, 0, 1)

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over ranks."""
        return masks.fixed_mask(count, context.at(self.visible_ratio, "visible_ratio", 0, 1))

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """Instances for the contract suite."""
        return [
            cls(site),
            cls(site, visible_ratio=0.5, detach=True),
            cls(site, visible_ratio=Linear(0.3, 1.0)),
        ]


@register
@dataclass(frozen=True)
class CosineMask(Mask):
    """BARF's window: one octave after the other opens smoothly, along half a cosine.

    The lowest rank (the identity, if the site has it) is always open; the window runs over the ranks above
    it.

    Args:
        site: where it acts; its octaves, or its channel indices where it knows none, are the ranks.
        until: fraction of the run (float) or step (int) from which all is open.
        detach: closed channels keep their values and only lose their gradient.

    Source: BARF (Lin et al., ICCV 2021), equation 14; Nerfies (Park et al., ICCV 2021), equation 8.

    >>> CosineMask("encoding.position", until=0.5).until
    0.5
    """

    until: Numeric = 0.9

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        super().__post_init__()
        check_until(self.until)

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over ranks."""
        if count == 1:
            return torch.ones(1)
        window = masks.cosine_mask(count - 1, context.step, context.end(self.until))
        return torch.cat([torch.ones(1), window])

    def end(self, count: int, total_steps: int) -> int | None:
        """The step that `until` stands for."""
        return _fixed_end(self.until, total_steps)

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """Instances for the contract suite."""
        return [cls(site), cls(site, until=5), cls(site, detach=True)]


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

    Source: Neuralangelo (Li et al., CVPR 2023), section 3.2: 4 levels, one more every 5,000 of 500,000 steps.

    >>> LevelMask("hash", start=4, every=5000).features
    2
    """

    start: Numeric = 4
    every: Numeric = 0.01
    begin: Numeric = 0
    features: int = 2

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        super().__post_init__()
        check_numeric("start", self.start, 1)
        check_until(self.every, "every")
        if self.begin != 0:
            check_until(self.begin, "begin")
        if isinstance(self.features, bool) or not self.features >= 1:
            raise InputError(f"features={self.features!r}: expected channels per level, an int above 0")

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
        start = context.at(self.start, "start", 1)
        return masks.level_mask(count, context.step, start=start, begin=begin, every=context.end(self.every))

    def end(self, count: int, total_steps: int) -> int | None:
        """The step at which the last level opens."""
        if not all(isinstance(value, (int, float)) for value in (self.start, self.every, self.begin)):
            return None
        begin = 0 if self.begin == 0 else end_step(self.begin, 0, total_steps)
        missing = max(0, math.ceil(count - self.start))  # type: ignore[operator]
        return begin + missing * end_step(self.every, 0, total_steps)

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """Instances for the contract suite."""
        return [
            cls(site, start=1, every=3, features=1),
            cls(site, start=2, every=0.05, begin=0.1, features=1),
            cls(site, start=1, every=0.2, features=1, detach=True),
        ]


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

    Source: SANeRF drops bands from 2 on.

    >>> ViewDependenceMask("encoding.direction", bands=0).bands
    0
    """

    bands: Numeric = 2
    until: Numeric | None = None
    coefficients: int | None = None

    def __post_init__(self) -> None:
        """Refuse what no run could use."""
        super().__post_init__()
        check_numeric("bands", self.bands, 0)
        if self.until is not None:
            check_until(self.until)
        if self.coefficients is not None and (
            isinstance(self.coefficients, bool) or not self.coefficients >= 1
        ):
            raise InputError(f"coefficients={self.coefficients!r}: expected coefficients per colour, or None")

    def ranks(self, place: Place) -> tuple[int, ...]:
        """Band of each channel."""
        if place.octaves is not None:
            return super().ranks(place)
        return masks.spherical_bands(place.channels or 0, self.coefficients)

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over bands."""
        if self.until is not None and context.step >= context.end(self.until):
            return torch.ones(count)
        return (torch.arange(count) < math.floor(context.at(self.bands, "bands", 0))).float()

    def end(self, count: int, total_steps: int) -> int | None:
        """The step that `until` stands for."""
        return None if self.until is None else _fixed_end(self.until, total_steps)

    @classmethod
    def examples(cls, site: SiteLike) -> list[Regularizer]:
        """Instances for the contract suite."""
        return [
            cls(site, bands=1),
            cls(site, bands=0),
            cls(site, bands=1, until=0.5),
            cls(site, bands=Linear(1, 10), detach=True),
        ]


def check_until(value: object, name: str = "until") -> None:
    """Refuse ends that are neither a positive step nor a fraction of the run.

    Raises:
        InputError: naming the argument and its value.
    """
    if isinstance(value, (int, float)):
        try:
            end_step(value, 0, 1)
        except InputError as error:
            raise InputError(str(error).replace("until", name, 1)) from None
    check_numeric(name, value)


def _fixed_end(until: Numeric, total_steps: int) -> int | None:
    """The step that `until` stands for, None where it depends on the step itself."""
    if isinstance(until, Schedule) or callable(until):
        return None
    return end_step(until, 0, total_steps)
