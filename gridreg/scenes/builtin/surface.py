"""The exact geometry of the built-in object: signed distance, points on its surface, and a mesh."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from gridreg.scenes.builtin.lighthouse import lighthouse
from gridreg.scenes.builtin.solids import rotate
from gridreg.scenes.builtin.tessellate import tessellate

__all__ = ["builtin_mesh", "builtin_signed_distance", "builtin_surface"]

Array = NDArray[np.float64]

_HIDDEN = -1e-9


def builtin_signed_distance(points: Array) -> Array:
    """Return the signed distance of world points to the object's surface, negative inside.

    The sign is exact everywhere and the value is exact outside. Inside it is that of the deepest single
    solid, so the true distance is never smaller in magnitude.

    Args:
        points: ``(N, 3)`` world units.

    Returns:
        ``(N,)`` world units.
    """
    points = np.asarray(points, dtype=np.float64)
    best: Array = np.full(len(points), np.inf)
    for part in lighthouse():
        centre = part.world(np.array([part.solid.middle]))[0]
        # A part that cannot come nearer than what another part gave needs no more work.
        near = np.flatnonzero(np.linalg.norm(points - centre, axis=-1) - part.solid.reach < best)
        best[near] = np.minimum(best[near], part.solid.distance(part.local(points[near])))
    return best


def builtin_surface(count: int, generator: torch.Generator) -> tuple[Array, Array]:
    """Draw points uniformly from the object's surface.

    Args:
        count: number of points.
        generator: where the random numbers come from.

    Returns:
        ``(count, 3)`` points and ``(count, 3)`` outward unit normals, world.
    """
    rng = np.random.default_rng(int(torch.randint(2**62, (1,), generator=generator)))
    parts = lighthouse()
    areas = np.array([part.solid.area for part in parts])
    points, normals = np.empty((0, 3)), np.empty((0, 3))
    while len(points) < count:
        counts = rng.multinomial(2 * (count - len(points)) + 64, areas / areas.sum())
        batch, batch_normals = [], []
        for part, number in zip(parts, counts, strict=True):
            local = part.solid.sample(int(number), rng)
            batch.append(part.world(local))
            batch_normals.append(rotate(part.solid.normal(local), part.axes.T))
        drawn, drawn_normals = np.concatenate(batch), np.concatenate(batch_normals)
        # Shuffled, so that cutting the list to `count` favours no part.
        order = rng.permutation(len(drawn))
        order = order[builtin_signed_distance(drawn[order]) > _HIDDEN]
        points = np.concatenate([points, drawn[order]])
        normals = np.concatenate([normals, drawn_normals[order]])
    return points[:count], normals[:count]


def builtin_mesh(edge: float = 0.02) -> tuple[Array, NDArray[np.int64]]:
    """Return the object's surface as triangles.

    Vertices lie on the surface; triangles that other solids hide are left out, those across a seam are
    kept whole, so they reach into the other solid by at most ``edge``. The mesh is therefore not watertight.

    Args:
        edge: longest edge of a triangle along a solid's face, world units.

    Returns:
        ``(V, 3)`` vertices and ``(F, 3)`` vertex indices, counter-clockwise seen from outside.
    """
    vertices, faces, offset = [], [], 0
    for part in lighthouse():
        corners, triangles = tessellate(part.solid, edge)
        corners = part.world(corners)
        hidden = builtin_signed_distance(corners) < -1e-6
        vertices.append(corners)
        faces.append(triangles[~hidden[triangles].all(axis=1)] + offset)
        offset += len(corners)
    joined = np.concatenate(faces)
    used, renumbered = np.unique(joined, return_inverse=True)
    return np.concatenate(vertices)[used], renumbered.reshape(-1, 3).astype(np.int64)
