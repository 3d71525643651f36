"""A texture for a mesh: its faces laid flat (xatlas), and each pixel coloured as the field is seen there."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw
from scipy import ndimage  # type: ignore[import-untyped]

from gridreg.errors import InputError
from gridreg.export.marching import vertex_normals
from gridreg.export.mesh import Mesh, seen_colours
from gridreg.export.volume import SeenDensity
from gridreg.rendering import Field, OccupancyGrid

Array = NDArray[np.float64]


def check_texture(size: int) -> None:
    """Refuse a texture before minutes of work.

    Raises:
        InputError: for an edge out of range, or without xatlas.
    """
    if not 16 <= size <= 8192:
        raise InputError(f"texture={size}: expected the edge in pixels, from 16 to 8192")
    if importlib.util.find_spec("xatlas") is None:
        raise InputError("texture: xatlas is not installed, expected: pip install 'gridreg[texture]'")


def textured(mesh: Mesh, field: Field, occupancy: OccupancyGrid | None, size: int, resolution: int) -> Mesh:
    """The same surface with a texture: vertices on seams are doubled.

    Args:
        mesh: in the field's coordinates.
        field: gives the colours.
        occupancy: cells that count; None: everywhere.
        size: edge of the texture, pixels.
        resolution: of the lattice that the mesh was cut from, whose cells are the depth that colours are taken over.
    """
    xatlas = importlib.import_module("xatlas")
    kept, faces, places = xatlas.parametrize(mesh.vertices.astype(np.float32), mesh.faces.astype(np.uint32))
    faces, vertices = faces.astype(np.int64), mesh.vertices[kept]
    normals = vertex_normals(mesh.vertices, mesh.faces)[kept]
    rows, columns, face, weights = _pixels(places.astype(np.float64), faces, size)
    seen = np.zeros((size, size, 3), dtype=np.uint8)
    points, directions = (
        np.einsum("nk,nkd->nd", weights, values[faces[face]]) for values in (vertices, normals)
    )
    directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-12)
    box = field.bounds[1] - field.bounds[0]
    depth = float(box.max()) / (resolution - 1)
    seen[rows, columns] = seen_colours(field, SeenDensity(field, occupancy), points, directions, depth)
    filled = np.zeros((size, size), dtype=bool)
    filled[rows, columns] = True
    # Between the charts, where bilinear lookups reach: the nearest colour.
    nearest = ndimage.distance_transform_edt(~filled, return_distances=False, return_indices=True)
    return replace(
        mesh,
        vertices=vertices,
        faces=faces,
        colours=None,
        places=np.asarray(places, dtype=np.float64),
        texture=seen[tuple(nearest)],
    )


def _pixels(
    places: Array, faces: NDArray[np.int64], size: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64], Array]:
    """Row and column of pixels on faces, the face of each, and its barycentric weights ``(N, 3)``."""
    corners = (places * [size, -size] + [0, size])[faces]
    drawn = Image.new("I", (size, size), 0)
    pen = ImageDraw.Draw(drawn)
    for number, triangle in enumerate((corners - 0.5).tolist(), 1):
        pen.polygon([tuple(corner) for corner in triangle], fill=number)
    found = np.asarray(drawn)
    rows, columns = np.nonzero(found)
    face = found[rows, columns].astype(np.int64) - 1
    a, b, c = corners[face].transpose(1, 0, 2)
    p = np.stack([columns + 0.5, rows + 0.5], axis=-1)

    def area(u: Array, v: Array, w: Array) -> Array:
        return np.asarray((v - u)[:, 0] * (w - u)[:, 1] - (v - u)[:, 1] * (w - u)[:, 0])

    whole = area(a, b, c)
    weights = np.stack([area(p, b, c), area(a, p, c), area(a, b, p)], axis=-1)
    weights = (weights / np.where(whole == 0, 1, whole)[:, None]).clip(0, None)
    # Pixels on an outline have their centre a little outside.
    return rows, columns, face, weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-12)
