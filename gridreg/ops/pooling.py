"""One colour for several faint samples: most samples that a ray sees weigh next to nothing.

Neighbours among them are pooled until they weigh a given amount, and one of them, drawn in proportion to its weight,
lends its colour to the pool. The expected colour of a ray, and the expected gradient of every colour, are those of
evaluating them all; the gradient of a weight sees the colour of its pool, in expectation the pool's mean, in place of
the sample's own.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["UNIT", "pool_faint"]

# Of weights as integers: fine enough for any that counts, and eight million samples of weight 1 still add up.
UNIT = 2.0**40


@torch.no_grad()
def pool_faint(
    weights: Tensor, rays: Tensor, bound: float, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Pools of consecutive faint samples, and one speaker of each.

    A pool holds samples of one ray that are lighter than ``bound``, with no heavier one between them; it weighs less
    than twice ``bound``. A sample that weighs at least ``bound`` is alone in its pool.

    Args:
        weights: ``(K,)`` positive, packed by ray, in order along it.
        rays: ``(K,)`` the ray of each.
        bound: weight, unitless.
        generator: draws the speakers, in proportion to weight; None: the one at half of the pool's weight.

    Returns:
        ``speakers (P,)`` int64, one index into the samples for every pool, increasing; and ``pools (K,)`` int64, the
        pool of each sample, never decreasing.

    Example:
        >>> w, r = torch.tensor([0.5, 0.001, 0.004, 0.5]), torch.tensor([0, 0, 0, 1])
        >>> [x.tolist() for x in pool_faint(w, r, 0.01)]
        [[0, 2, 3], [0, 1, 1, 2]]
    """
    heavy = weights >= bound
    # Integers add up exactly, so that a ray's pools do not depend on the rays before it.
    w = (weights.double() * UNIT).long().clamp(min=1)
    running = w.cumsum(0)
    light = torch.where(heavy, 0, w)
    passed = light.cumsum(0) - light
    new_ray = torch.ones_like(heavy)
    new_ray[1:] = rays[1:] != rays[:-1]
    begun = passed[new_ray][new_ray.cumsum(0) - 1]
    bucket = (passed - begun) // max(1, int(bound * UNIT))
    first = new_ray.clone()
    first[1:] |= (bucket[1:] != bucket[:-1]) | heavy[1:] | heavy[:-1]
    pools = first.cumsum(0) - 1
    starts = first.nonzero().squeeze(-1)
    ends = torch.cat([starts[1:], starts.new_tensor([len(w)])])[: len(starts)]
    before = (running - w)[starts]
    total = running[ends - 1] - before
    if generator is None:
        share = total // 2
    else:
        drawn = torch.rand(len(starts), generator=generator, dtype=torch.float64, device=generator.device)
        share = torch.minimum((drawn.to(w.device) * total).long(), total - 1)
    return torch.searchsorted(running, before + share, right=True), pools
