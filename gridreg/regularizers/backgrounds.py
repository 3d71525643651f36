"""Backgrounds of the rays of a training step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE, within
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric

# Mean and variance of a colour drawn uniformly from [0, 1].
_MEAN, _VARIANCE = 1 / 2, 1 / 12


def random_background(count: int, generator: torch.Generator, per: Literal["ray", "batch"] = "ray") -> Tensor:
    """Uniform random colours to put behind both the render and the target of each ray.

    What is transparent in the target then has no colour of its own that the field could paint as matter.

    Args:
        count: number of rays.
        generator: source of the random numbers.
        per: "ray": each its own colour; "batch": one colour for all.

    Returns:
        ``(count, 3)`` in [0, 1), float32, on the generator's device. Source: Instant-NGP (Mueller et al.
        2022).

    Raises:
        InputError: `per` is neither.

    Example:
        >>> random_background(2, torch.Generator().manual_seed(0), per="batch").shape
        torch.Size([2, 3])
    """
    if per not in ("ray", "batch"):
        raise InputError(f"per={per!r}: expected 'ray' or 'batch'")
    drawn = torch.rand(count if per == "ray" else 1, 3, generator=generator, device=generator.device)
    return drawn.expand(count, 3)


def opacity_error(samples: RaySamples) -> Tensor:
    """Mean over rays of ``(o - a)^2``: opacity of the ray, alpha of its pixel; an unknown alpha (NaN) counts as met.

    Args:
        samples: with `target_opacity`.

    Returns:
        Scalar, unitless.

    Raises:
        InputError: the samples have no target opacity.

    Example:
        >>> density = torch.tensor([[1e3], [0.0], [0.0]])
        >>> alpha = torch.tensor([1.0, 1.0, float("nan")])
        >>> samples = RaySamples.from_dense(torch.ones(1), torch.ones(1), density, target_opacity=alpha)
        >>> round(opacity_error(samples).item(), 4)
        0.3333
    """
    target = samples.target_opacity
    if target is None:
        raise InputError("opacity_error needs samples with target_opacity, found none")
    error = samples.opacity - torch.where(target.isnan(), samples.opacity.detach(), target)
    return error.square().sum() / max(1, samples.rays)


@register
@dataclass(frozen=True)
class RandomBackground(Regularizer):
    """The same random colour behind render and target, new at each step: see `random_background`.

    It needs training images with transparency, and rays of the batch composited on `handle.background`.

    Args:
        per: "ray": each its own colour; "batch": one colour for all.
        until: fraction of the run (float) or step (int) from which the scene's own background is back.

    Formula: ``background ~ uniform [0, 1]^3``
    Unit: colour
    Source: Instant-NGP (Mueller et al. 2022)
    """

    per: Literal["ray", "batch"] = "ray"
    until: Numeric = 1.0
    ranges = within(until=NOT_NEGATIVE)
    example_arguments = ({}, {"per": "batch", "until": 0.5})

    def background(
        self, count: int, generator: torch.Generator, default: Tensor | None, context: Context
    ) -> Tensor | None:
        """Random colours until the end, on the device and with the type of the default."""
        if context.step >= context.end(self.until):
            return default
        drawn = random_background(count, generator, self.per)
        return drawn if default is None else drawn.to(default)

    def value(self, context: Context) -> float:
        """1 while backgrounds are random."""
        return float(context.step < context.end(self.until))


@register
@dataclass(frozen=True)
class ExpectedBackground(Regularizer):
    """Random backgrounds in expectation, without the noise of drawing them: see `RandomBackground`.

    Let a pixel be off by ``e`` in its colour before black and by ``d`` in its opacity. Before a background ``b`` it
    is off by ``e - d b``, and over all ``b`` in [0, 1]^3 the mean of its square, per channel, is
    ``(e - d / 2)^2 + d^2 / 12``. So render and target get the same grey behind them, for a loss of squared errors, and
    the second term is the penalty.

    It needs what `RandomBackground` needs, and samples with `RaySamples.target_opacity`.

    Args:
        weight: factor of the penalty; 1: the expectation.
        until: fraction of the run (float) or step (int) from which the scene's own background is back.

    Formula: ``background = 1/2``, ``mean((o - a)^2) / 12`` over rays, ``o`` the opacity, ``a`` the pixel's alpha
    Unit: squared colour
    Source: the expectation of Instant-NGP's random backgrounds (Mueller et al. 2022); gridreg
    """

    weight: Numeric = 1.0
    until: Numeric = 1.0
    ranges = within(until=NOT_NEGATIVE)
    required = ("target_opacity",)
    example_arguments = ({}, {"weight": 3.0, "until": 0.5})

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """`opacity_error` by the variance of a uniform colour; 0 from the end on."""
        return (_VARIANCE if context.step < context.end(self.until) else 0.0) * opacity_error(samples)

    def background(
        self, count: int, generator: torch.Generator, default: Tensor | None, context: Context
    ) -> Tensor | None:
        """Grey until the end, on the device and with the type of the default; the generator is not touched."""
        if context.step >= context.end(self.until):
            return default
        grey = torch.full((count, 3), _MEAN, device=generator.device)
        return grey if default is None else grey.to(default)

    def value(self, context: Context) -> float:
        """The weight while backgrounds are grey."""
        return super().value(context) if context.step < context.end(self.until) else 0.0
