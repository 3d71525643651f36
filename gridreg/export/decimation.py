"""Fewer triangles for the same shape."""

from __future__ import annotations

import importlib.util

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial import KDTree  # type: ignore[import-untyped]

from gridreg.errors import InputError

__all__ = ["check_faces", "decimate"]


def decimate(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], count: int
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Collapse edges until a mesh has at most so many faces, those first that change the shape least.

    Quadric error metrics (Garland and Heckbert 1997), trimesh's ``simplify_quadric_decimation``.

    Args:
        vertices, faces: ``(V, 3)`` world units, ``(F, 3)``.
        count: of faces, at least 4.

    Returns:
        Vertices, faces, and for every vertex the nearest one of before, whose colour it may take.
    """
    fewer = trimesh.Trimesh(vertices, faces, process=False).simplify_quadric_decimation(face_count=count)
    left = np.asarray(fewer.vertices)
    nearest = KDTree(vertices).query(left)[1]
    return left, np.asarray(fewer.faces, dtype=np.int64), np.asarray(nearest, dtype=np.int64)


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
