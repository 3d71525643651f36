"""Penalties on rays as a whole: entropies and distortion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from gridreg.attach.sites import within
from gridreg.base import Context, Regularizer, register
from gridreg.errors import InputError
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric
from gridreg.segments import before_less_behind

# Keeps logarithms of fractions finite; the value that InfoNeRF's program adds.
TINY = 1e-10


def _mean_over_rays(values: Tensor) -> Tensor:
    return values.sum() / max(values.shape[0], 1)


def alpha_of(samples: RaySamples) -> Tensor:
    """Opacity of each sample alone, ``1 - exp(-density delta)``, ``(N,)``."""
    return -torch.expm1(-samples.density * samples.delta)


def opacity_entropy(samples: RaySamples) -> Tensor:
    """Mean over rays of ``-o log o - (1 - o) log(1 - o)``: a ray should be opaque or clear, not in between.

    Args:
        samples: `R` rays; ``o`` is the sum of a ray's weights, clamped to [1e-6, 1 - 1e-6].

    Returns:
        Scalar in nats, at most log 2. Source: DVGO (Sun et al. 2022), background entropy.

    Example:
        >>> samples = RaySamples.from_dense(torch.ones(1, 1), torch.ones(1, 1), torch.tensor([[0.6931472]]))
        >>> round(opacity_entropy(samples).item(), 4)  # half opaque: log 2
        0.6931
    """
    opacity = samples.opacity.clamp(1e-6, 1 - 1e-6)
    return _mean_over_rays(-opacity * opacity.log() - (1 - opacity) * torch.log1p(-opacity))


def ray_entropy(samples: RaySamples, threshold: float = 0.1) -> Tensor:
    """Mean over rays of the entropy of where along the ray the matter is, for rays that meet some.

    With ``alpha_i = 1 - exp(-density_i delta_i)`` and ``p_i = alpha_i / sum_j alpha_j``, the entropy is
    ``-sum_i p_i log p_i``; rays with opacity up to the threshold count as 0.

    Args:
        samples: `R` rays.
        threshold: opacity in [0, 1], not differentiated.

    Returns:
        Scalar in nats; InfoNeRF's program takes log base 2, which is 1.4427 times as much. Source: InfoNeRF
        (Kim et al. 2022), ray entropy minimization, with the opacity in place of ``sum alpha`` as in its
        program.

    Example:
        >>> two = RaySamples.from_dense(torch.tensor([[1.0, 2.0]]), torch.ones(1, 2), torch.ones(1, 2))
        >>> round(ray_entropy(two).item(), 4)  # two equal lumps: log 2
        0.6931
    """
    alpha = alpha_of(samples)
    share = alpha / (samples.spread(samples.sum_per_ray(alpha)) + TINY)
    entropy = samples.sum_per_ray(-share * torch.log(share + TINY))
    return _mean_over_rays(torch.where(samples.opacity.detach() > threshold, entropy, 0.0))


def _interval(near: float | None, far: float | None) -> float:
    """Length that counts as 1."""
    if near is None and far is None:
        return 1.0
    if near is None or far is None or not far > near:
        raise InputError(f"near={near}, far={far}: expected both with far beyond near, or neither")
    return far - near


class _Distortion(torch.autograd.Function):
    """Sum over rays of `distortion` in units of t, and what it changes by, from two running sums.

    For rising ``t``, and with ``m_i`` the weight before sample i less the weight behind it, the sum over j of
    ``w_j |t_i - t_j|`` is ``t_i m_i`` less the same difference of ``w_j t_j``.
    """

    @staticmethod
    def forward(
        ctx: Any, weights: Tensor, t: Tensor, delta: Tensor, offsets: Tensor, ray_indices: Tensor
    ) -> Tensor:
        """Scalar, in units of t; all but the offsets are ``(N,)``."""
        w, wide = weights.double(), t.double()
        lead = before_less_behind(w, offsets, ray_indices)
        away = (wide * lead).sub_(before_less_behind(w * wide, offsets, ray_indices))
        within = w * delta
        ctx.save_for_backward(w, lead, away, within)
        return (away.dot(w) + within.dot(w) / 3).to(weights.dtype)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of weights, t and delta, where they are asked for."""
        w, lead, away, within = ctx.saved_tensors
        wanted = ctx.needs_input_grad
        of_weights = (away + within / 3).mul_(2 * gradient) if wanted[0] else None
        of_t = (w * lead).mul_(2 * gradient) if wanted[1] else None
        of_delta = w.square().mul_(gradient / 3) if wanted[2] else None
        found = (of_weights, of_t, of_delta)
        return (*(x if x is None else x.to(gradient.dtype) for x in found), None, None)


def distortion(samples: RaySamples, near: float | None = None, far: float | None = None) -> Tensor:
    """Mean over rays of ``sum_ij w_i w_j |s_i - s_j| + sum_i w_i^2 d_i / 3``: matter in one short stretch.

    In O(N), from running sums; differentiable once.

    Args:
        samples: `R` rays with `t` rising along each.
        near: distance that is ``s = 0``, world units.
        far: distance that is ``s = 1``, world units; give both, or neither for ``s = t``.

    Returns:
        Scalar, in units of ``s``. Source: mip-NeRF 360 (Barron et al. 2022), equation 15; the O(N) form is
        from Sun et al. 2022 (DVGO version 2).

    Raises:
        InputError: only one of near and far is given, or far is not beyond near.

    Example:
        >>> t, density = torch.tensor([1.0, 3.0]), torch.full((1, 2), 100.0)
        >>> samples = RaySamples.from_dense(t, torch.ones(2), density)
        >>> round(distortion(samples).item(), 4)  # all weight in the first interval, of length 1
        0.3333
    """
    scale = 1.0 / _interval(near, far)
    total: Tensor = _Distortion.apply(  # type: ignore[no-untyped-call]
        samples.weights, samples.t, samples.lengths, samples.offsets, samples.ray_indices
    )
    return total * (scale / max(samples.rays, 1))


@dataclass(frozen=True)
class SamplesPenalty(Regularizer):
    """Base of penalties that are a function of the samples alone.

    Class attributes:
        function: the penalty without its weight, of `RaySamples` alone, as a static method.
    """

    function: ClassVar[Any]
    example_arguments = ({},)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """The function of the samples."""
        found: Tensor = self.function(samples)
        return found


@register
@dataclass(frozen=True)
class OpacityEntropy(SamplesPenalty):
    """Rays half opaque are penalised: see `opacity_entropy`.

    Args:
        weight: factor of the loss; DVGO: 0.01 in its coarse stage, 0.001 in its fine one.

    Formula: ``mean(-o log o - (1 - o) log(1 - o))`` over rays, ``o`` the opacity
    Unit: nats
    Source: DVGO (Sun et al. 2022), background entropy loss
    """

    weight: Numeric = 1e-3
    function = staticmethod(opacity_entropy)


@register
@dataclass(frozen=True)
class RayEntropy(Regularizer):
    """Rays whose matter is spread out are penalised: see `ray_entropy`.

    Args:
        weight: factor of the loss; InfoNeRF: 0.001 (with logarithms to base 2).
        threshold: opacity up to which a ray does not count, in [0, 1].

    Formula: ``mean(-sum p log p)`` over rays with opacity > threshold, ``p = alpha / sum alpha``
    Unit: nats
    Source: InfoNeRF (Kim et al. 2022), ray entropy minimization
    """

    weight: Numeric = 1e-3
    threshold: Numeric = 0.1
    ranges = within(threshold=(0.0, 1.0))
    example_arguments = ({}, {"threshold": 0.0})

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """`ray_entropy` with the threshold of this step."""
        return ray_entropy(samples, self.now("threshold", context))


@register
@dataclass(frozen=True)
class DistortionLoss(Regularizer):
    """Weight spread along a ray is penalised: see `distortion`.

    Args:
        weight: factor of the loss; 0.001 to 0.002 on few-shot grids, 0.01 in mip-NeRF 360.
        near: distance that counts as 0, world units.
        far: distance that counts as 1, world units; None for both: distances count in world units.

    Formula: ``mean(sum_ij w_i w_j |s_i - s_j| + sum_i w_i^2 d_i / 3)`` over rays
    Unit: world units, or none with near and far
    Source: mip-NeRF 360 (Barron et al. 2022), equation 15
    """

    weight: Numeric = 1e-3
    near: float | None = None
    far: float | None = None
    example_arguments = ({}, {"near": 0.0, "far": 4.0})

    def __post_init__(self) -> None:
        super().__post_init__()
        _interval(self.near, self.far)

    def penalty(self, samples: RaySamples, context: Context) -> Tensor:
        """`distortion`."""
        return distortion(samples, self.near, self.far)
