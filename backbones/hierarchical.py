"""Coarse and fine sampling of rays, hierarchical sampling (NeRF, section 5.2)."""

from __future__ import annotations

import torch
from torch import Tensor


def stratified(t_min: Tensor, t_max: Tensor, count: int, jitter: Tensor) -> tuple[Tensor, Tensor]:
    """One sample in each of ``count`` equal parts of every ray.

    Args:
        t_min, t_max: ``(R,)``, world units.
        count: parts ``S`` of a ray.
        jitter: ``(R,)`` in [0, 1), where in its part each sample lies; 0.5 is the middle.

    Returns:
        Distances ``(R, S)`` and the edges of the parts ``(R, S + 1)``, world units.

    Example:
        >>> t, edges = stratified(torch.tensor([2.0]), torch.tensor([4.0]), 2, torch.tensor([0.5]))
        >>> t.tolist(), edges.tolist()
        ([[2.5, 3.5]], [[2.0, 3.0, 4.0]])
    """
    fractions = torch.arange(count + 1, dtype=t_min.dtype, device=t_min.device) / count
    edges = torch.lerp(t_min[:, None], t_max[:, None], fractions)
    return torch.lerp(edges[:, :-1], edges[:, 1:], jitter[:, None]), edges


def inverse_transform(
    edges: Tensor, weights: Tensor, count: int, jitter: Tensor, padding: float = 1e-5
) -> Tensor:
    """Samples distributed as weights that are constant within each part of a ray.

    Args:
        edges: ``(R, S + 1)``, rising.
        weights: ``(R, S)``, at least 0.
        count: samples ``K`` to draw, one at each of ``K`` equal steps of the distribution.
        jitter: ``(R,)`` in [0, 1), where in its step each sample lies.
        padding: added to every weight, so that a ray without any is sampled evenly (NeRF's program: 1e-5).

    Returns:
        ``(R, K)``, rising.

    Example:
        >>> edges, weights = torch.tensor([[0.0, 1.0, 2.0]]), torch.tensor([[0.0, 5.0]])
        >>> inverse_transform(edges, weights, 2, torch.tensor([0.5]), padding=0.0).tolist()
        [[1.25, 1.75]]
    """
    cumulative = (weights + padding).cumsum(-1)
    cumulative = torch.nn.functional.pad(cumulative / cumulative[:, -1:], (1, 0))
    steps = torch.arange(count, dtype=edges.dtype, device=edges.device)
    wanted = ((steps + jitter[:, None]) / count).contiguous()
    part = (torch.searchsorted(cumulative, wanted, right=True) - 1).clamp(0, weights.shape[1] - 1)
    low, high = cumulative.gather(1, part), cumulative.gather(1, part + 1)
    fraction = ((wanted - low) / (high - low).clamp(min=torch.finfo(edges.dtype).tiny)).clamp(0, 1)
    return torch.lerp(edges.gather(1, part), edges.gather(1, part + 1), fraction)


def intervals(t: Tensor, t_min: Tensor, t_max: Tensor) -> Tensor:
    """Length of ray that each sample stands for: from half-way to the one before to half-way to the next.

    NeRF gives each sample the way to the next one, and the last one 1e10; so what lies before the first is
    left out, and the last is opaque as soon as its density is not 0. Here the lengths add up to that of the
    ray.

    Args:
        t: ``(R, S)``, rising.
        t_min, t_max: ``(R,)``, the ends of the rays.

    Returns:
        Lengths ``(R, S)``, world units.

    Example:
        >>> intervals(torch.tensor([[1.0, 3.0]]), torch.zeros(1), torch.full((1,), 4.0)).tolist()
        [[2.0, 2.0]]
    """
    middle = (t[:, 1:] + t[:, :-1]) / 2
    return torch.cat([t_min[:, None], middle, t_max[:, None]], dim=1).diff(dim=1)
