"""From densities on a lattice to a closed triangle mesh (marching cubes, Lorensen and Cline 1987)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage, sparse  # type: ignore[import-untyped]
from skimage.measure import marching_cubes

from gridreg.export.volume import DensityVolume

Vertices = NDArray[np.float64]
Faces = NDArray[np.int64]
Density = Callable[[Vertices], NDArray[np.float32]]

# Vertices keep this fraction of an edge away from its ends: closer, neighbouring vertices would fall together.
_MARGIN = 0.02


def polygonise(
    volume: DensityVolume,
    threshold: float,
    density: Density | None = None,
    *,
    refine: int = 8,
    fill_cavities: bool = True,
) -> tuple[Vertices, Faces]:
    """Closed surface around the densities above a threshold.

    One empty layer around the lattice closes surfaces at the faces of the box. Marching cubes runs on
    ``density / (density + threshold)`` at 1/2: the same level set, but a density spans orders of magnitude
    between two nodes, and linear interpolation of it would stick every vertex to the emptier node. The
    vertices then move along their lattice edges to where the density itself crosses the threshold, found by
    bisection.

    Args:
        volume: densities at lattice nodes.
        threshold: density per world unit, above 0.
        density: world positions ``(N, 3)`` to densities ``(N,)``, 0 outside the box; None: no bisection.
        refine: bisection steps; the vertices are then within ``2**-(refine + 1)`` of a lattice edge, but for
            the fraction of 0.02 that they keep from its ends.
        fill_cavities: leave out surfaces that are closed off from the outside.

    Returns:
        Vertices ``(V, 3)`` in world units and faces ``(F, 3)``, counterclockwise seen from outside; both
        empty when no node is above the threshold.
    """
    # In place and in this order: at 512 nodes along an edge every copy of the lattice is half a GB.
    solid = np.pad(volume.values >= threshold, 1)
    if not solid.any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    cavities = _cavities(solid) if fill_cavities else None
    level = np.pad(volume.values, 1)
    for layer, within in zip(level, solid, strict=True):
        layer /= layer + np.float32(threshold)
        # A node right on the level would give several vertices in one place.
        layer[within] = np.maximum(layer[within], 0.5 + _MARGIN)
        layer[~within] = np.minimum(layer[~within], 0.5 - _MARGIN)
    if cavities is not None:
        level[cavities] = 1.0
        del cavities
    # scikit-image calls outward faces of solids with large values "ascent".
    found, faces, _, _ = marching_cubes(level, 0.5, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    del level
    index = found.astype(np.float64)
    if density is not None and refine > 0:
        index = _on_level(
            index, solid, threshold, lambda i: density(volume.lower + (i - 1) * volume.spacing), refine
        )
    # The empty layer is a device: the surface itself ends at the box.
    index = np.clip(index - 1, 0, np.array(volume.values.shape) - 1)
    return volume.lower + index * volume.spacing, faces.astype(np.int64)


def _cavities(solid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the empty nodes that cannot be reached from the first one, which is empty."""
    empty: NDArray[np.bool_] = ~solid
    labels, _ = ndimage.label(empty)
    for layer, labelled in zip(empty, labels, strict=True):
        layer &= labelled != labels[0, 0, 0]
    return empty


def _on_level(
    index: Vertices, solid: NDArray[np.bool_], threshold: float, density: Density, steps: int
) -> Vertices:
    """Move the vertices that lie on lattice edges to the crossing, bisecting between the edge's two nodes."""
    between = np.abs(index - np.round(index)) > 1e-6
    # Ambiguous cells also have a vertex inside: it belongs to no edge and stays.
    moved = np.flatnonzero(between.sum(axis=1) == 1)
    axis = between[moved].argmax(axis=1)
    rows = np.arange(moved.size)
    below = np.round(index[moved])
    below[rows, axis] = np.floor(index[moved, axis])
    step = np.zeros_like(below)
    step[rows, axis] = 1.0
    corner = below.astype(np.int64)
    rising = ~solid[corner[:, 0], corner[:, 1], corner[:, 2]]
    inside = np.where(rising, 1.0, 0.0)
    outside = 1.0 - inside
    for _ in range(steps):
        middle = (inside + outside) / 2
        hit = density(below + middle[:, None] * step) >= threshold
        inside, outside = np.where(hit, middle, inside), np.where(hit, outside, middle)
    place = np.clip((inside + outside) / 2, _MARGIN, 1 - _MARGIN)
    result: Vertices = index.copy()
    result[moved] = below + place[:, None] * step
    return result


def vertex_normals(vertices: Vertices, faces: Faces) -> Vertices:
    """Return outward unit normals ``(V, 3)``: those of the faces around each vertex, weighted by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    of_faces = np.cross(b - a, c - a)
    total: Vertices = np.zeros_like(vertices)
    for corner in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], of_faces[:, axis], minlength=len(vertices))
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total /= np.maximum(length, np.finfo(np.float64).tiny)
    total[length[:, 0] == 0] = (0.0, 0.0, 1.0)
    return total


def drop_small_components(vertices: Vertices, faces: Faces, least: float) -> tuple[Vertices, Faces]:
    """Keep the connected parts whose surface is at least ``least`` of the surface of the largest part.

    Args:
        vertices, faces: the mesh; at least one face.
        least: in [0, 1]; 0 keeps everything, 1 the largest part alone.
    """
    pairs = np.concatenate([faces[:, :2], faces[:, 1:]])
    graph = sparse.coo_matrix((np.ones(len(pairs), np.int8), pairs.T), shape=(len(vertices), len(vertices)))
    _, part_of_vertex = sparse.csgraph.connected_components(graph, directed=False)
    part = part_of_vertex[faces[:, 0]]
    surface = np.bincount(part, trimesh.Trimesh(vertices, faces, process=False).area_faces)
    kept = faces[(surface >= least * surface.max())[part]]
    used, renumbered = np.unique(kept, return_inverse=True)
    return vertices[used], renumbered.reshape(-1, 3).astype(np.int64)
