"""Fewer triangles for the same shape."""

from __future__ import annotations

import importlib.util
import itertools

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import sparse  # type: ignore[import-untyped]
from scipy.spatial import KDTree  # type: ignore[import-untyped]

from gridreg.errors import InputError

Vertices = NDArray[np.float64]
Indices = NDArray[np.int64]

# Copies of a vertex move so far to their own neighbours, relative to the distance: who merges does not join them again.
_APART = 1e-3
_ATTEMPTS = 16


def decimate(vertices: Vertices, faces: Indices, count: int) -> tuple[Vertices, Indices, Indices]:
    """Collapse edges until a mesh has at most so many faces, those first that change the shape least.

    Quadric error metrics (Garland and Heckbert 1997), trimesh's ``simplify_quadric_decimation``. It may leave edges
    with four faces, where two parts of the surface have met: there they are taken apart, so that a closed mesh whose
    edges have two faces each stays one.

    Args:
        vertices, faces: ``(V, 3)`` world units, ``(F, 3)``.
        count: of faces, at least 4.

    Returns:
        Vertices, faces, and for every vertex the nearest one of before, whose colour it may take.

    Raises:
        InputError: if so few faces enclose nothing any more.
    """
    left, kept, before = vertices, faces, len(faces) + 1
    # The library may stop early where nothing can be collapsed that is not in the way of something else.
    while len(kept) < before and (left is vertices or len(kept) > count):
        before = len(kept)
        fewer = trimesh.Trimesh(left, kept, process=False).simplify_quadric_decimation(face_count=count)
        kept = _without_folds(np.asarray(fewer.faces, dtype=np.int64))
        if not len(kept):
            raise InputError(f"faces={count}: so few leave nothing of the shape, expected more")
        left, kept = _cut_to_manifold(np.asarray(fewer.vertices), kept)
    nearest = KDTree(vertices).query(left)[1]
    return left, kept, np.asarray(nearest, dtype=np.int64)


def _without_folds(faces: Indices) -> Indices:
    """Return the faces without those that lie back to back or have a corner twice, which enclose nothing."""
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    first = (faces.argmin(axis=1)[:, None] + np.arange(3)) % 3
    kept: dict[tuple[int, ...], list[int]] = {}
    for number, (a, b, c) in enumerate(np.take_along_axis(faces, first, axis=1).tolist()):
        if kept.get((a, c, b)):
            kept[a, c, b].pop()
        else:
            kept.setdefault((a, b, c), []).append(number)
    return faces[sorted(number for same in kept.values() for number in same)]


def _cut_to_manifold(vertices: Vertices, faces: Indices) -> tuple[Vertices, Indices]:
    """Give the parts of a surface that touch at an edge or a vertex vertices of their own (Gueziec et al. 1998)."""
    for attempt in range(_ATTEMPTS):
        # Half-edge h runs from corner h to the next one of its face; the third corner lies across.
        start, end, across = (np.roll(faces, -k, axis=1).ravel() for k in range(3))
        edge = np.unique(np.sort([start, end], axis=0), axis=1, return_inverse=True)[1].ravel()
        order, size = edge.argsort(kind="stable"), np.bincount(edge)
        crowded = np.flatnonzero(size > 2)
        if attempt and not len(crowded):
            break
        pairs, used = [order[size[edge[order]] == 2].reshape(-1, 2)], set[int]()
        for number in crowded:
            around = order[np.searchsorted(edge[order], number) :][: size[number]]
            ends = {int(start[around[0]]), int(end[around[0]])}
            # Where both ends are still joined by another way around them, another pairing parts them, for sure if no
            # second edge of theirs changes as well.
            shift = attempt if used.isdisjoint(ends) else 0
            used |= ends
            pairs.append(_paired(vertices, around, start, end, across, shift))
        vertices, faces = _joined(vertices, faces, np.concatenate(pairs))
    return vertices, faces


def _joined(vertices: Vertices, faces: Indices, pairs: Indices) -> tuple[Vertices, Indices]:
    """Return the mesh whose faces have vertices in common where they meet in one of the pairs of half-edges alone."""
    following = np.roll(np.arange(faces.size).reshape(-1, 3), -1, axis=1)
    one, other = pairs.T
    same = faces.ravel()[one] == faces.ravel()[other]
    then = following.ravel()
    links = (
        np.concatenate([one, then[one]]),
        np.concatenate([np.where(same, other, then[other]), np.where(same, then[other], other)]),
    )
    graph = sparse.coo_matrix((np.ones(len(links[0]), np.int8), links), shape=(faces.size, faces.size))
    count, vertex = sparse.csgraph.connected_components(graph, directed=False)
    origin = np.zeros(count, np.int64)
    origin[vertex] = faces.ravel()
    # The mean of the other corners of a vertex's own faces.
    around = (vertices[faces].sum(axis=1, keepdims=True) - vertices[faces]).reshape(-1, 3) / 2
    middle = np.stack([np.bincount(vertex, axis) for axis in around.T], axis=1) / np.bincount(vertex)[:, None]
    copied = (np.bincount(origin)[origin] > 1)[:, None]
    moved = vertices[origin] + np.where(copied, _APART * (middle - vertices[origin]), 0.0)
    return moved, vertex.reshape(-1, 3).astype(np.int64)


def _paired(
    vertices: Vertices, around: Indices, start: Indices, end: Indices, across: Indices, shift: int
) -> Indices:
    """Return the half-edges of one edge in pairs, between whose faces the solid lies, or with ``shift`` in others."""
    low, high = sorted((int(start[around[0]]), int(end[around[0]])))
    along = vertices[high] - vertices[low]
    along = along / max(float(np.linalg.norm(along)), np.finfo(np.float64).tiny)
    away = vertices[across[around]] - vertices[low]
    away = away - (away @ along)[:, None] * along
    turn = np.argsort(np.arctan2(away @ np.cross(along, away[0]), away @ away[0]), kind="stable")
    # Normals point outwards: turning about the edge, the solid begins at a face that runs down it.
    begun: list[int] = []
    down: list[int] = []
    up: list[int] = []
    twice = around[np.concatenate([turn, turn])].tolist()
    left = dict.fromkeys(twice)
    for half in twice:
        if half in left and (start[half] == high or begun):
            del left[half]
            if start[half] == high:
                begun.append(half)
            else:
                down.append(begun.pop())
                up.append(half)
    # Of a mesh that was open before there may be others, which stay together.
    alone = [*begun, *left]
    pairs = [*zip(down, np.roll(up, shift).tolist(), strict=True), *itertools.pairwise(alone)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def check_faces(count: int) -> None:
    """Refuse a number of faces before minutes of work.

    Raises:
        InputError: for less than four, or without the package that does it.
    """
    if count < 4:
        raise InputError(f"faces={count}: expected at least 4, those of a tetrahedron")
    if importlib.util.find_spec("fast_simplification") is None:
        raise InputError(
            "faces: fast-simplification is not installed, expected: pip install 'gridreg[train]'"
        )
