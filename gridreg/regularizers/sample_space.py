"""Intervals of the rays of a training step."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE, within
from gridreg.base import Context, Regularizer, register
from gridreg.schedules import Numeric


def anneal_space(
    near: Tensor, far: Tensor, progress: float, *, start: float = 0.5, middle: float = 0.5
) -> tuple[Tensor, Tensor]:
    """Shrink the interval of each ray about a point inside it, so that at first only the middle is sampled.

    ``m + (near - m) eta`` and ``m + (far - m) eta`` with ``m = near + middle (far - near)`` and
    ``eta = min(max(progress, start), 1)``.

    Args:
        near: ``(R,)`` distances, world units.
        far: ``(R,)`` distances, world units.
        progress: fraction of the annealing that is over; from 1 on the interval is whole.
        start: fraction of the interval at the beginning, in [0, 1].
        middle: where in the interval the point lies, in [0, 1].

    Returns:
        The new near and far; at the end the tensors themselves. Source: RegNeRF (Niemeyer et al. 2022),
        sample space annealing.

    Example:
        >>> import torch
        >>> near, far = anneal_space(torch.tensor([2.0]), torch.tensor([6.0]), progress=0.0)
        >>> near.item(), far.item()
        (3.0, 5.0)
    """
    share = min(max(progress, start), 1.0)
    if share == 1:
        return near, far
    centre = near + middle * (far - near)
    return centre + (near - centre) * share, centre + (far - centre) * share


@register
@dataclass(frozen=True)
class SampleSpaceAnnealing(Regularizer):
    """Rays are sampled only around their middle at first, then wider: see `anneal_space`.

    Args:
        until: fraction of the run (float) or step (int) from which the whole interval is sampled; RegNeRF:
            256 steps, 512 on some scenes.
        start: fraction of the interval at the beginning, in [0, 1]; RegNeRF: 0.5.
        middle: where in the interval the middle lies, in [0, 1]; RegNeRF: 0.5.

    Formula: ``[m + (near - m) eta, m + (far - m) eta]``, ``eta = clamp(t / T, start, 1)``
    Unit: world units
    Source: RegNeRF (Niemeyer et al. 2022), sample space annealing
    """

    until: Numeric = 256
    start: Numeric = 0.5
    middle: Numeric = 0.5
    ranges = within(until=NOT_NEGATIVE, start=(0.0, 1.0), middle=(0.0, 1.0))
    example_arguments = ({}, {"until": 0.5, "start": 0.1, "middle": 0.0})

    def near_far(self, near: Tensor, far: Tensor, context: Context) -> tuple[Tensor, Tensor]:
        """`anneal_space` at this step."""
        return anneal_space(
            near,
            far,
            context.step / context.end(self.until),
            start=self.now("start", context),
            middle=self.now("middle", context),
        )

    def value(self, context: Context) -> float:
        """Fraction of the interval now."""
        progress = context.step / context.end(self.until)
        return min(max(progress, self.now("start", context)), 1.0)
