"""Parts of k-means as scikit-learn computes it, for protocols that choose views by it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["greedy_plus_plus", "lloyd", "squared_distances"]


def greedy_plus_plus(
    points: NDArray[np.float64], count: int, random: np.random.RandomState
) -> NDArray[np.float64]:
    """Draw ``(count, 3)`` starting centres: each the best of some candidates by what is left of the
    distances."""
    chosen = [int(random.choice(len(points), p=np.full(len(points), 1 / len(points))))]
    gap = squared_distances(points, points[chosen])[:, 0]
    while len(chosen) < count:
        drawn = random.uniform(size=2 + int(np.log(count))) * gap.sum()
        candidates = np.minimum(np.searchsorted(np.cumsum(gap), drawn), len(points) - 1)
        left = np.minimum(gap, squared_distances(points[candidates], points))
        best = int(left.sum(axis=1).argmin())
        gap = left[best]
        chosen.append(int(candidates[best]))
    return points[chosen]


def lloyd(points: NDArray[np.float64], centres: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the inertia and the centres where the clusters, or nearly the centres, no longer change."""
    tolerance = 1e-4 * float(points.var(axis=0).mean())
    before = np.full(len(points), -1)
    for _ in range(300):
        nearest = squared_distances(points, centres).argmin(axis=1)
        members = [points[nearest == k] for k in range(len(centres))]
        moved = np.stack([m.mean(axis=0) if len(m) else c for m, c in zip(members, centres, strict=True)])
        shift, centres = float(((moved - centres) ** 2).sum()), moved
        if np.array_equal(nearest, before) or shift <= tolerance:
            break
        before = nearest
    return float(squared_distances(points, centres).min(axis=1).sum()), centres


def squared_distances(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ``(N, M)`` squared distances of ``(N, 3)`` to ``(M, 3)`` points."""
    return np.asarray(((a[:, None] - b[None]) ** 2).sum(axis=-1))
