"""Gradients of what is close to a camera count less."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE, within
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric
from gridreg.segments import optical_depth_to_weights


class _ScaledGradient(torch.autograd.Function):
    """The value of one tensor with the gradient of another, times a factor."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, path: Tensor, factor: Tensor | None) -> Tensor:
        """The value."""
        ctx.factor = factor
        return value.view_as(value)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[None, Tensor, None]:
        """The path's gradient, times the factor."""
        return None, gradients[0] if ctx.factor is None else gradients[0] * ctx.factor, None


def _scaled(path: Tensor, factor: Tensor | None, value: Tensor | None = None) -> Tensor:
    """`path` with its gradient times a factor, or another value in its place."""
    found: Tensor = _ScaledGradient.apply((path if value is None else value).detach(), path, factor)  # type: ignore[no-untyped-call]
    return found


def scale_gradients_by_distance(samples: RaySamples, distance: float = 1.0) -> RaySamples:
    """Multiply the gradient of density and colour at each sample by ``clamp((t / distance)^2, 0, 1)``.

    Near a camera a cell is seen by more rays than far away and so gets larger gradients: floating matter
    grows there. No value changes, bit for bit.

    Args:
        samples: `N` samples whose weights follow from density and delta (`optical_depth_to_weights`).
        distance: from the camera, world units, from which on gradients count in full.

    Returns:
        The samples, with the same values. Source: Floaters No More (Philip and Deschaintre 2023).

    Raises:
        InputError: the distance is not above 0.

    Example:
        >>> density = torch.ones(1, 2, requires_grad=True)
        >>> samples = RaySamples.from_dense(torch.tensor([0.5, 2.0]), torch.ones(2), density)
        >>> scale_gradients_by_distance(samples).density.sum().backward()
        >>> density.grad
        tensor([[0.2500, 1.0000]])
    """
    if not distance > 0:
        raise InputError(f"distance={distance}: expected a length above 0")
    factor = (samples.t / distance).square().clamp(0, 1).detach()
    density = _scaled(samples.density, factor)
    # Weights came from the unscaled density: derive them again for the gradient, and keep their values.
    path = optical_depth_to_weights(density * samples.delta, samples.offsets)
    colours = None if samples.colours is None else _scaled(samples.colours, factor[:, None])
    return samples.replace(density=density, weights=_scaled(path, None, samples.weights), colours=colours)


@register
@dataclass(frozen=True)
class DistanceGradientScaling(Regularizer):
    """Gradients of what is close to a camera count less: see `scale_gradients_by_distance`.

    Args:
        distance: from the camera, world units, from which on gradients count in full.

    Formula: gradients of density and colour times ``clamp((t / distance)^2, 0, 1)``
    Unit: none
    Source: Floaters No More (Philip and Deschaintre 2023)
    """

    distance: Numeric = 1.0
    shown = "distance"
    ranges = within(distance=NOT_NEGATIVE)
    example_arguments = ({}, {"distance": 5.0})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.distance == 0:
            raise InputError(f"distance={self.distance}: expected a length above 0")

    def on_samples(self, samples: RaySamples, context: Context) -> RaySamples:
        """`scale_gradients_by_distance` with the distance of this step."""
        return scale_gradients_by_distance(samples, self.now("distance", context))
