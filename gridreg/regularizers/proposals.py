"""Penalty that teaches proposal networks where the final samples found matter."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from gridreg.base import register
from gridreg.errors import InputError
from gridreg.regularizers.rays import SamplesPenalty
from gridreg.samples import RaySamples
from gridreg.schedules import Numeric

# As in nerfstudio's `interlevel_loss`; keeps the quotient finite where nothing was found.
_TINY = 1e-7
# Intervals that touch should not overlap by rounding: an end counts from this fraction of its length inwards.
_TOUCH = 1e-3


def proposal_loss(samples: RaySamples) -> Tensor:
    """Weight of the final samples beyond what the proposals' intervals at the same place allow.

    ``mean over rays of sum_i max(0, w_i - b_i)^2 / (w_i + 1e-7)``, where ``b_i`` is the sum of the weights of those
    intervals of a proposal that overlap interval i; added over the proposals. The final samples get no gradient.

    Args:
        samples: with `proposals`; intervals are ``t - delta / 2`` to ``t + delta / 2``.

    Returns:
        Scalar, no unit; differentiable by the proposals' weights. Source: mip-NeRF 360 (Barron et al. 2022), equation
        13; nerfstudio's `interlevel_loss`, which divides by the number of samples of a ray as well.

    Raises:
        InputError: the samples have no proposals.

    Example:
        >>> t, density = torch.tensor([[0.5, 1.5]]), torch.tensor([[0.0, 99.0]])
        >>> fine = RaySamples.from_dense(t, torch.ones(2), density)
        >>> off = RaySamples.from_dense(t, torch.ones(2), density.flip(1))
        >>> [round(proposal_loss(fine.replace(proposals=(p,))).item(), 4) for p in (fine, off)]
        [0.0, 1.0]
    """
    if samples.proposals is None:
        raise InputError("proposal_loss needs samples with proposals, found None")
    weights = samples.weights.detach()
    total = weights.new_zeros(())
    for proposal in samples.proposals:
        excess = (weights - _allowed(samples, proposal)).clamp(min=0)
        total = total + (excess.square() / (weights + _TINY)).sum()
    return total / max(samples.rays, 1)


def _allowed(samples: RaySamples, proposal: RaySamples) -> Tensor:
    """Sum of the proposal's weights over its intervals that overlap each sample's interval, ``(N,)``."""
    if len(proposal) == 0 or len(samples) == 0:
        return torch.zeros_like(samples.weights)
    with torch.no_grad():
        (first, last), (starts, ends) = _ends(samples, 1 - 2 * _TOUCH), _ends(proposal)
        low = torch.minimum(first.min(), starts.min())
        # All rays on one axis, each in a stretch of its own, so that one search serves them all.
        stretch = torch.maximum(last.max(), ends.max()) - low + 1
        place, where = samples.ray_indices * stretch - low, proposal.ray_indices * stretch - low
        begin = torch.searchsorted(ends + where, first + place, right=True)
        behind = torch.searchsorted(starts + where, last + place).maximum(begin)
    running = torch.cat([proposal.weights.new_zeros(1).double(), proposal.weights.double().cumsum(0)])
    return (running[behind] - running[begin]).to(samples.weights.dtype)


def _ends(samples: RaySamples, share: float = 1.0) -> tuple[Tensor, Tensor]:
    """Beginning and end of the middle fraction of each sample's interval, in float64."""
    t, half = samples.t.double(), samples.lengths.double() * (share / 2)
    return t - half, t + half


@register
@dataclass(frozen=True)
class ProposalLoss(SamplesPenalty):
    """Proposal networks are drawn to cover what the final samples found: see `proposal_loss`.

    Args:
        weight: factor of the loss; mip-NeRF 360 and nerfstudio: 1 (nerfstudio's mean over samples is smaller).

    Formula: ``mean(sum_i max(0, w_i - b_i)^2 / w_i)`` over rays, ``b_i`` the proposal's weight that overlaps sample i
    Unit: none
    Source: mip-NeRF 360 (Barron et al. 2022), equation 13
    """

    weight: Numeric = 1.0
    function = staticmethod(proposal_loss)
    required = ("proposals",)
