"""Dropout of whole components: the grid analogue of dropping Gaussians."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from gridreg.attach.sites import SiteLike, within
from gridreg.base import Context, Regularizer, register
from gridreg.regularizers.mask_base import broadcast, remember, spread
from gridreg.schedules import Linear, Numeric, check_numeric

_HIGHEST = 0.999
_RAMP = Linear(0.0, 0.2)


def component_dropout(channels: int, p: float, generator: torch.Generator) -> Tensor:
    """Random factors that drop channels and keep the expectation: 0 with probability `p`, else 1 / (1 - p).

    Args:
        channels: number of channels.
        p: probability to drop a channel, in [0, 0.999].
        generator: source of the random numbers.

    Returns:
        Factors of shape `(channels,)`, float32.

    Raises:
        InputError: the probability is out of range.

    >>> component_dropout(4, 0.5, torch.Generator().manual_seed(1))
    tensor([2., 0., 0., 2.])
    """
    check_numeric("p", p, 0, _HIGHEST)
    return (torch.rand(channels, generator=generator) >= p).float() / (1 - p)


@register
@dataclass(frozen=True)
class ComponentDropout(Regularizer):
    """Drops whole channels at random while training, drawn anew at each `handle.step`.

    It is off at p = 0, and wherever the module that owns the tensor is in eval mode (`module.training` at the
    time of access, so `field.eval()` is enough).

    Args:
        site: where it acts.
        p: probability to drop a channel, in [0, 0.999].

    Formula: each channel times ``0`` with probability p, else ``1 / (1 - p)``
    Unit: none
    Source: none for grids; DropGaussian (Park et al., CVPR 2025) does it to Gaussians with p = 0.2 t / T.
    """

    train_only: ClassVar[bool] = True

    site: SiteLike
    p: Numeric = _RAMP
    shown = "p"
    ranges = within(p=(0.0, _HIGHEST))
    example_arguments = ({}, {"p": 0.5}, {"p": 0.0})

    def prepare(self, context: Context) -> None:
        """Draw the factors of this step."""
        if context.place is not None and context.place.channels is not None:
            p = self.now("p", context)
            # Drawn at p = 0 too, so that the random numbers that follow do not depend on p.
            factors = component_dropout(context.place.channels, p, context.generator)
            remember(context, "factors", spread(factors, context.place))

    def is_identity(self, context: Context) -> bool:
        """Nothing dropped."""
        return self.now("p", context) == 0

    def transform(self, value: Tensor, context: Context) -> Tensor:
        """Multiply the channels by their factors."""
        factors = broadcast(context, "factors", value)
        return torch.where(factors > 0, value * factors, 0.0)
