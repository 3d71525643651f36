"""Triangles on the surface of the convex solids."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from gridreg.scenes.builtin.solids import Ball, Cuboid, Frustum, Solid

__all__ = ["tessellate"]

Array = NDArray[np.float64]
Mesh = tuple[Array, NDArray[np.int64]]


def tessellate(solid: Solid, edge: float) -> Mesh:
    """Return ``(V, 3)`` vertices on the surface and ``(F, 3)`` triangles, counter-clockwise from outside.

    Patches do not share vertices along their rims.

    Args:
        solid: one of the solids of this package.
        edge: wanted length of edges, world units.

    Raises:
        TypeError: for a solid of another class.
    """
    if isinstance(solid, Cuboid):
        return _joined([_cuboid_face(solid, axis, side, edge) for axis in range(3) for side in (-1, 1)])
    if isinstance(solid, Ball):
        polar = np.linspace(0, math.pi, _steps(math.pi * solid.radius, edge))
        return _lathe(solid.radius * np.sin(polar), -solid.radius * np.cos(polar), edge)
    if isinstance(solid, Frustum):
        low, high = solid.low, solid.high
        side = _steps(math.hypot(solid.height, high - low), edge)
        bottom, top = _steps(low, edge), _steps(high, edge)
        return _joined(
            [
                _lathe(np.linspace(0, low, bottom), np.zeros(bottom), edge),
                _lathe(np.linspace(low, high, side), np.linspace(0, solid.height, side), edge),
                _lathe(np.linspace(high, 0, top), np.full(top, solid.height), edge),
            ]
        )
    raise TypeError(f"no tessellation for a {type(solid).__name__}")


def _steps(length: float, edge: float) -> int:
    return max(2, math.ceil(length / edge) + 1)


def _lathe(radii: Array, levels: Array, edge: float) -> Mesh:
    """Turn a profile, given from below outwards and up, about z."""
    around = max(8, math.ceil(2 * math.pi * radii.max() / edge))
    angle = 2 * np.pi * np.arange(around + 1) / around
    vertices = np.stack(
        [
            radii[:, None] * np.cos(angle),
            radii[:, None] * np.sin(angle),
            np.broadcast_to(levels[:, None], (len(levels), around + 1)),
        ],
        axis=-1,
    )
    return vertices.reshape(-1, 3), _grid_faces(len(radii), around + 1)[:, ::-1]


def _cuboid_face(cuboid: Cuboid, axis: int, side: int, edge: float) -> Mesh:
    half = np.array(cuboid.half)
    u, v = (axis + 1) % 3, (axis + 2) % 3
    along_u = np.linspace(-half[u], half[u], _steps(2 * half[u], edge))
    along_v = np.linspace(-half[v], half[v], _steps(2 * half[v], edge))
    vertices = np.empty((len(along_u), len(along_v), 3))
    vertices[..., axis] = side * half[axis]
    vertices[..., u] = along_u[:, None]
    vertices[..., v] = along_v
    faces = _grid_faces(len(along_u), len(along_v))
    return vertices.reshape(-1, 3), faces if side > 0 else faces[:, ::-1]


def _grid_faces(rows: int, columns: int) -> NDArray[np.int64]:
    """Two triangles for every cell of a grid of vertices, turning from rows to columns."""
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    lower = np.stack([corner, corner + columns, corner + columns + 1], axis=-1)
    upper = np.stack([corner, corner + columns + 1, corner + 1], axis=-1)
    return np.concatenate([lower, upper]).astype(np.int64)


def _joined(meshes: list[Mesh]) -> Mesh:
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    faces = [triangles + offset for (_, triangles), offset in zip(meshes, offsets, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)
