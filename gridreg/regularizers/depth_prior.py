"""Penalties that compare depth with a file of the user's, which is right up to scale, shift or order."""

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

# Variances below this, in squared units, are none: keeps the quotients of flat depths finite.
_TINY = 1e-12


def _known(samples: RaySamples) -> tuple[Tensor, Tensor, Tensor]:
    """Depth, target and number of the image of the rays whose target is known."""
    if samples.target_depth is None:
        raise InputError("a depth prior needs samples with target_depth, found None")
    known = ~samples.target_depth.isnan()
    depth, target = samples.depth[known], samples.target_depth[known]
    if samples.images is None:
        return depth, target, torch.zeros(len(depth), dtype=torch.int64, device=depth.device)
    return depth, target, torch.unique(samples.images[known], return_inverse=True)[1]


def _moments(samples: RaySamples) -> tuple[Tensor, Tensor, Tensor]:
    """Variance of depth and of target, and their covariance, in each image whose target is not flat."""
    depth, target, image = _known(samples)
    counts = image.bincount()

    def mean(values: Tensor) -> Tensor:
        return values.new_zeros(len(counts)).index_add(0, image, values) / counts

    d, z = depth - mean(depth)[image], target - mean(target)[image]
    of_target = mean(z * z)
    used = of_target > _TINY
    return mean(d * d)[used], of_target[used], mean(d * z)[used]


def _mean(values: Tensor) -> Tensor:
    return values.sum() / max(len(values), 1)


def depth_correlation(samples: RaySamples) -> Tensor:
    """Mean over images of ``1 - r``, with Pearson's correlation ``r`` of depth and target depth.

    Args:
        samples: with `target_depth`; rays whose target is NaN do not count. Each of `images` has a correlation of
            its own, as monocular depth has a scale and a shift of its own there.

    Returns:
        Scalar in [0, 2]; 0 where depth is the target up to scale and shift. Source: FSGS (Zhu et al. 2024) and
        SparseGS (Xiong et al. 2023), Pearson depth losses.

    Example:
        >>> t = torch.tensor([[1.0], [2.0], [4.0]])
        >>> rays = RaySamples.from_dense(t, torch.ones(1), torch.full((3, 1), 99.0), target_depth=3 * t[:, 0] - 1)
        >>> round(depth_correlation(rays).item(), 4), round(depth_residual(rays).item(), 4)
        (0.0, 0.0)
    """
    of_depth, of_target, both = _moments(samples)
    return _mean(1 - both * ((of_depth + _TINY) * (of_target + _TINY)).rsqrt())


def depth_residual(samples: RaySamples) -> Tensor:
    """Mean over images of the squared difference of target depth and depth, after the best scale and shift.

    ``min over s, q of mean (s d + q - z)^2 = var z - cov(d, z)^2 / var d`` for depth ``d`` and target ``z``.

    Args:
        samples: as in `depth_correlation`.

    Returns:
        Scalar, squared unit of the target. Source: MiDaS (Ranftl et al. 2020), scale- and shift-invariant loss; in
        rendering MonoSDF (Yu et al. 2022), equation 12.
    """
    of_depth, of_target, both = _moments(samples)
    return _mean(of_target - both.square() / (of_depth + _TINY))


def depth_ranking(samples: RaySamples, offset: float = 0.5, margin: float = 1e-4) -> Tensor:
    """Mean of ``max(0, d_near - d_far + margin)`` over pairs of rays, one nearer than the other by its target.

    In each image the rays are ordered by their target, and each is paired with the one that stands a fraction `offset`
    of the image's rays behind it, round about; pairs of equal targets do not count.

    Args:
        samples: as in `depth_correlation`.
        offset: in [0, 1); drawn anew at each step, it makes all pairs equally likely.
        margin: world units.

    Returns:
        Scalar, world units. Source: SparseNeRF (Wang et al. 2023), local depth ranking, there in patches of
        random position.

    Example:
        >>> t = torch.tensor([[1.0], [2.0]])
        >>> rays = RaySamples.from_dense(t, torch.ones(1), torch.full((2, 1), 99.0), target_depth=-t[:, 0])
        >>> round(depth_ranking(rays).item(), 4)
        1.0001
    """
    depth, target, image = _known(samples)
    by_target = target.argsort(stable=True)
    order = by_target[image[by_target].argsort(stable=True)]
    depth, target, image = depth[order], target[order], image[order]
    counts = image.bincount()
    first, count = (counts.cumsum(0) - counts)[image], counts[image]
    number = torch.arange(len(depth), device=depth.device) - first
    partner = first + (number + 1 + (offset * (count - 1)).long()) % count
    # Behind the last one the order begins again: there the partner is the nearer.
    sign = (target[partner] - target).sign()
    excess = (sign * (depth - depth[partner]) + margin).clamp(min=0)
    return excess[sign != 0].sum() / (sign != 0).sum().clamp(min=1)


@register
@dataclass(frozen=True)
class DepthPrior(Regularizer):
    """Depth should agree with a monocular estimate: see `depth_correlation`, `depth_ranking`, `depth_residual`.

    The estimate is the user's (a file of MiDaS, Depth Anything, a sensor, ...), in `RaySamples.target_depth`, growing
    with the distance: of an inverse depth pass the negative, whose order is right, or its reciprocal.

    Args:
        weight: factor of the loss; FSGS: 0.05, MonoSDF: 0.1 falling to 0.
        form: "pearson", "ranking", or "scale_shift".
        margin: of the ranking, world units; SparseNeRF: 1e-4.

    Formula: per image, with depth d and target z: ``1 - corr(d, z)``; ``mean(max(0, d_near - d_far + margin))``
    over pairs; or ``min_{s, q} mean((s d + q - z)^2)``
    Unit: none; world units; squared unit of the target
    Source: FSGS (Zhu et al. 2024); SparseNeRF (Wang et al. 2023); MonoSDF (Yu et al. 2022), after MiDaS
    """

    weight: Numeric = 0.05
    form: Literal["pearson", "ranking", "scale_shift"] = "pearson"
    margin: Numeric = 1e-4
    ranges = within(margin=NOT_NEGATIVE)
    required = ("target_depth",)
    example_arguments = ({}, {"form": "ranking"}, {"form": "scale_shift"})

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """The form's function; pairs of the ranking change with the step."""
        if self.form == "ranking":
            offset = float(torch.rand((), generator=context.step_generator()))
            return depth_ranking(samples, offset, self.now("margin", context))
        return depth_correlation(samples) if self.form == "pearson" else depth_residual(samples)
