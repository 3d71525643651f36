"""The occlusion loss: density close to the cameras (FreeNeRF's `occ_reg`)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from gridreg.attach.sites import NOT_NEGATIVE
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric


def occlusion_loss(
    samples: RaySamples,
    count: float | None = None,
    *,
    distance: float | None = None,
    on: Literal["density", "weights"] = "density",
    colour_prior: float | None = None,
    near: float | None = None,
) -> Tensor:
    """Density close to the cameras, where a few views leave floating walls: mean of density times mask.

    The mask is 1 on the first `count` steps of a ray, or within `distance`, and on samples up to step
    `colour_prior` that are nearly white or black (mean colour above 0.99 or below 0.01).

    The sum is divided by the number of all steps of all rays, as FreeNeRF's mean over a full rectangle of
    samples is; steps that the march skipped count as density 0. So the value does not depend on what was
    skipped, and a ray that misses the box adds nothing. It does depend on the fraction of the ray that is
    masked: with half the step length `count` covers half the distance, while `distance` means the same.

    Args:
        samples: `R` rays with `N` samples.
        count: number of steps from the ray's entry into the box; None: 20, unless `distance` is given.
        distance: the same as a length, world units.
        on: ``"density"`` (per world unit) or ``"weights"`` (which what lies in front can hide).
        colour_prior: number of steps; None: no prior. A colour of exactly 0 was not evaluated, and does not
            count as black.
        near: distance along the ray where `distance` begins, world units; None: the ray's entry into the
            box.

    Returns:
        Scalar, per world unit (on density) or without unit (on weights). Source: FreeNeRF (Yang et al.
        2023), occlusion regularization, and its program for the prior.

    Raises:
        InputError: both count and distance are given, `on` is unknown, or the prior finds no colours.

    Example:
        >>> import torch
        >>> samples = RaySamples.from_dense(torch.arange(4.0), torch.ones(4), torch.ones(1, 4))
        >>> occlusion_loss(samples, 1).item(), occlusion_loss(samples, distance=1.5).item()
        (0.25, 0.5)
    """
    if count is not None and distance is not None:
        raise InputError(f"count={count}, distance={distance}: expected one of them")
    if on not in ("density", "weights"):
        raise InputError(f"on={on!r}: expected 'density' or 'weights'")
    if distance is None:
        mask = samples.index < (20 if count is None else count)
    else:
        mask = samples.t - (samples.spread(samples.start) if near is None else near) < distance
    if colour_prior is not None:
        if samples.colours is None:
            raise InputError("colour_prior needs samples with colours, found none")
        mean = samples.colours.detach().mean(-1)
        evaluated = (samples.colours.detach() != 0).any(-1)
        extreme = evaluated & ((mean > 0.99) | (mean < 0.01))
        mask = mask | (extreme & (samples.index < colour_prior))
    values = samples.density if on == "density" else samples.weights
    return (values * mask).sum() / samples.steps.sum().clamp(min=1)


@register
@dataclass(frozen=True)
class OcclusionLoss(Regularizer):
    """Density close to the cameras is penalised (FreeNeRF's `occ_reg_loss`): see `occlusion_loss`.

    Args:
        weight: factor of the loss; FreeNeRF: 0.01.
        samples: number of steps from the ray's entry; None: 20, unless `distance` is given. FreeNeRF: 20 on
            Blender scenes, 10 on DTU.
        distance: the same as a length, world units, which does not change when the step does.
        on: "density" or "weights".
        colour_prior: number of steps in which nearly white and nearly black samples count too; None: no
            prior. FreeNeRF: 20 on DTU.
        near: distance along the ray where `distance` begins, world units; None: the ray's entry into the
            box.

    Formula: ``mean(density * [step < samples])`` over all steps of all rays
    Unit: per world unit (on weights: none)
    Source: FreeNeRF (Yang et al. 2023), occlusion regularization
    """

    weight: Numeric = 0.01
    samples: Numeric | None = None
    distance: Numeric | None = None
    on: Literal["density", "weights"] = "density"
    colour_prior: Numeric | None = None
    near: Numeric | None = None
    ranges = dict.fromkeys(("samples", "distance", "colour_prior", "near"), NOT_NEGATIVE)
    example_arguments = ({}, {"distance": 0.5, "on": "weights"}, {"samples": 3, "colour_prior": 5})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples is not None and self.distance is not None:
            raise InputError(f"samples={self.samples}, distance={self.distance}: expected one of them")

    def needs(self) -> tuple[str, ...]:
        """Colours, for the prior."""
        return () if self.colour_prior is None else ("colours",)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """`occlusion_loss` with the numbers of this step."""
        now = {n: None if getattr(self, n) is None else self.now(n, context) for n in self.ranges}
        return occlusion_loss(samples, now.pop("samples"), on=self.on, **now)
