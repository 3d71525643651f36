"""Merge low-weight samples: one colour for several neighbours, as most samples of a ray weigh next to nothing.

Consecutive samples are merged until they weigh a given amount, and one of them, the representative, is drawn in
proportion to its weight and lends its colour to the group. The expected colour of a ray, and the expected gradient of
every colour, are those of evaluating them all; the gradient of a weight sees the colour of its group, in expectation
the group's mean, in place of the sample's own.

Where surfaces have formed, most of a ray's weight lies on a few neighbours that are alike. `average_features` joins
groups whose features are averaged, so that the colour network is asked once for all of them.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from gridreg.ops.composite import check_packed, ray_of_sample
from gridreg.ops.dispatch import operation

# Of weights as integers: fine enough for any that counts, and eight million samples of weight 1 still add up.
UNIT = 2.0**40


@torch.no_grad()
def merge_neighbours(
    weights: Tensor, rays: Tensor, bound: float, generator: torch.Generator | None = None
) -> tuple[Tensor, Tensor]:
    """Groups of consecutive low-weight samples, and one representative of each.

    A group holds samples of one ray that are lighter than ``bound``, with no heavier one between them; it weighs less
    than twice ``bound``. A sample that weighs at least ``bound`` is a group of its own.

    Args:
        weights: ``(K,)`` positive, packed by ray, in order along it.
        rays: ``(K,)`` the ray of each.
        bound: weight, unitless.
        generator: draws the representatives, in proportion to weight; None: the one at half of the group's weight.

    Returns:
        ``representatives (G,)`` int64, one index into the samples for every group, increasing; and ``groups (K,)``
        int64, the group of each sample, never decreasing.

    Example:
        >>> w, r = torch.tensor([0.5, 0.001, 0.004, 0.5]), torch.tensor([0, 0, 0, 1])
        >>> [x.tolist() for x in merge_neighbours(w, r, 0.01)]
        [[0, 2, 3], [0, 1, 1, 2]]
    """
    heavy = weights >= bound
    # Integers add up exactly, so that a ray's groups do not depend on the rays before it.
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
    groups = first.cumsum(0) - 1
    starts = first.nonzero().squeeze(-1)
    ends = torch.cat([starts[1:], starts.new_tensor([len(w)])])[: len(starts)]
    before = (running - w)[starts]
    total = running[ends - 1] - before
    if generator is None:
        drawn = total // 2
    else:
        uniform = torch.rand(len(starts), generator=generator, dtype=torch.float64, device=generator.device)
        drawn = torch.minimum((uniform.to(w.device) * total).long(), total - 1)
    return torch.searchsorted(running, before + drawn, right=True), groups


def _check(weights: Tensor, offsets: Tensor, *others: object) -> None:
    check_packed(weights, offsets, "weights")


@operation(check=_check)
@torch.no_grad()
def merge_samples(
    weights: Tensor,
    offsets: Tensor,
    floor: float,
    bound: float,
    generator: torch.Generator | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """Samples whose colour is evaluated, and the groups that share it.

    Args:
        weights: ``(N,)``.
        offsets: ``(R + 1,)`` int64.
        floor: samples that do not weigh more have no colour.
        bound: lighter neighbours are merged until they weigh this much; not above ``floor``: none are.
        generator: draws the representatives, in proportion to weight; None: the one at half of the group's weight.

    Returns:
        ``representatives (G,)`` int64, one sample of every group, increasing; ``rays (G,)`` int64, theirs; ``groups
        (N,)`` int64, the group of each sample, -1 for none. Not differentiable.

    Raises:
        InputError: if ``offsets`` does not end at N.

    Example:
        >>> weights = torch.tensor([0.5, 0.001, 0.0, 0.004, 0.5])
        >>> [x.tolist() for x in merge_samples(weights, torch.tensor([0, 4, 5]), 1e-4, 0.01)]
        [[0, 3, 4], [0, 0, 1], [0, 1, -1, 1, 2]]
    """
    chosen = (weights > floor).nonzero().squeeze(-1)
    rays = ray_of_sample(offsets, weights.numel())[chosen]
    representatives = merged = torch.arange(len(chosen), device=chosen.device)
    if bound > floor:
        representatives, merged = merge_neighbours(weights[chosen], rays, bound, generator)
    groups = torch.full_like(weights, -1, dtype=torch.int64)
    groups[chosen] = merged
    return chosen[representatives], rays[representatives], groups


class FeatureMeans(NamedTuple):
    """Runs of neighbours on a ray whose features are averaged.

    Args:
        fractions: ``(G,)``, weight of each group of `merge_samples` in its run.
        offsets: ``(P + 1,)`` int64; run p holds the groups ``offsets[p] : offsets[p + 1]``.
        of_samples: ``(N,)`` int64, the run of each sample, -1 for none.
    """

    fractions: Tensor
    offsets: Tensor
    of_samples: Tensor


@torch.no_grad()
def average_features(weights: Tensor, groups: Tensor, rays: Tensor, bound: float) -> FeatureMeans:
    """Join neighbouring groups until they weigh ``bound``; a run of several weighs less than twice that.

    Args:
        weights: ``(N,)``.
        groups, rays: from `merge_samples`.
        bound: weight, unitless; a group that weighs as much stays alone.

    Example:
        >>> groups, rays = torch.tensor([0, -1, 1, 2]), torch.tensor([0, 0, 0])
        >>> found = average_features(torch.tensor([0.3, 0.0, 0.1, 0.5]), groups, rays, 0.5)
        >>> [x.tolist() for x in (found.offsets, found.of_samples)]
        [[0, 2, 3], [0, -1, 0, 1]]
    """
    # What samples in no group weigh is added up in front, and left out.
    of_groups = weights.new_zeros(len(rays) + 1).index_add_(0, groups + 1, weights)[1:]
    _, runs = merge_neighbours(of_groups, rays, bound)
    offsets = F.pad(torch.bincount(runs).cumsum(0), (1, 0))
    totals = weights.new_zeros(len(offsets) - 1).index_add_(0, runs, of_groups)
    return FeatureMeans(of_groups / totals[runs], offsets, F.pad(runs, (1, 0), value=-1)[groups + 1])


@operation()
def spread_to_samples(colours: Tensor, groups: Tensor, representatives: Tensor) -> Tensor:
    """Colours of samples from those of their groups; 0 for a sample in none.

    Args:
        colours: ``(G, C)`` of the representatives.
        groups, representatives: from `merge_samples`.

    Returns:
        ``(N, C)``, differentiable once.

    Example:
        >>> groups, representatives = torch.tensor([0, -1, 1, 1]), torch.tensor([0, 2])
        >>> spread_to_samples(torch.tensor([[0.5], [1.0]]), groups, representatives).tolist()
        [[0.5], [0.0], [1.0], [1.0]]
    """
    # The last row is that of samples in no group.
    return torch.cat([colours, colours.new_zeros(1, colours.shape[1])])[groups]
