"""Masks as regularizers: which channels of a site are open at which step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gridreg.attach.sites import Place, within
from gridreg.base import Context, register
from gridreg.regularizers import mask_functions as masks
from gridreg.regularizers.mask_base import Mask
from gridreg.schedules import Linear, Numeric


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

    Formula: ``p = min(L/B t/T + 1, L/B)``; channels below ``B int(p)`` 1, the next B ``p - int(p)``, the rest
    0
    Unit: none
    Source: FreeNeRF (Yang et al., CVPR 2023), section 3.3; on components of a grid: Few TensoRF.

    >>> FrequencyMask("density", until=0.9)
    FrequencyMask(site='density', detach=False, until=0.9, block=None, variant='block')
    """

    until: Numeric = 0.9
    block: int | None = None
    variant: Literal["block", "printed", "authors"] = "block"
    counts = (("block", "a number of channels, an int above 0, or None"),)
    example_arguments = (
        {"until": 0.9},
        {"until": 7, "block": 2},
        {"until": 0.5, "detach": True},
        {"variant": "authors"},
        {"variant": "printed"},
    )

    def ranks(self, place: Place) -> tuple[int, ...]:
        """By octave where known; the variants know only the index."""
        if self.variant == "block":
            return super().ranks(place)
        return tuple(range(place.channels or 0))

    def mask(self, context: Context) -> Tensor:
        """The mask over the channels that take part, shape `(channels,)`."""
        place = context.place
        channels = 0 if place is None or place.octaves is not None else place.channels or 0
        if self.variant == "block" and self.block is None and channels:
            # Fewer channels than a block count as one block.
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

    def monotone(self) -> bool:
        """Not in the printed form."""
        return self.variant != "printed"


@register
@dataclass(frozen=True)
class FixedMask(Mask):
    """The lowest fraction of the channels (of the octaves, where known) stays open, the rest closed.

    Args:
        site: where it acts.
        visible_ratio: open fraction, in [0, 1]: the first `int(channels * visible_ratio)`.
        detach: closed channels keep their values and only lose their gradient.

    Formula: the first ``int(L visible_ratio)`` channels 1, the rest 0
    Unit: none
    Source: Few TensoRF, human-body runs with 0.8.
    """

    visible_ratio: Numeric = 0.8
    ranges = within(visible_ratio=(0.0, 1.0))
    example_arguments = ({}, {"visible_ratio": 0.5, "detach": True}, {"visible_ratio": Linear(0.3, 1.0)})

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over ranks."""
        return masks.fixed_mask(count, self.now("visible_ratio", context))


@register
@dataclass(frozen=True)
class CosineMask(Mask):
    """BARF's window: one octave after the other opens smoothly, along half a cosine.

    The identity, octave -1, is always open; the window runs over the octaves, and at step 0 all of them are closed.
    Where a site knows no octaves, its first channel stands for the identity, and the others for octaves.

    Args:
        site: where it acts.
        until: fraction of the run (float) or step (int) from which all is open.
        detach: closed channels keep their values and only lose their gradient.

    Formula: ``(1 - cos(pi clamp(L t/T - k, 0, 1))) / 2`` for octave k
    Unit: none
    Source: BARF (Lin et al., ICCV 2021), equation 14; Nerfies (Park et al., ICCV 2021), equation 8.
    """

    until: Numeric = 0.9
    example_arguments = ({}, {"until": 5}, {"detach": True})

    def ranks(self, place: Place) -> tuple[int, ...]:
        """By octave where known; rank 0 is the identity's, whether or not the site has it."""
        without = place.octaves is not None and min(place.octaves, default=0) >= 0
        return tuple(rank + without for rank in super().ranks(place))

    def rank_values(self, count: int, context: Context) -> Tensor:
        """Mask over ranks."""
        if count == 1:
            return torch.ones(1)
        window = masks.cosine_mask(count - 1, context.step, context.end(self.until))
        return torch.cat([torch.ones(1), window])
