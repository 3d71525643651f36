"""Exact images and depth maps of the built-in object: every ray meets every solid in closed form."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gridreg.scenes.builtin.lighthouse import Part, lighthouse
from gridreg.scenes.builtin.materials import shade
from gridreg.scenes.builtin.solids import rotate

__all__ = ["Hits", "cast", "hit_colours", "render_rgba"]

Array = NDArray[np.float64]


class Hits(NamedTuple):
    """First hits of the rays through a grid of points in the image plane.

    Attributes:
        parameter: ``(h, w)`` depth along the optical axis, world units, ``inf`` where nothing is hit.
        part: ``(h, w)`` number of the part hit, -1 where none is.
        right: ``(w,)`` slope of the rays to the right, per unit of depth.
        down: ``(h,)`` slope of the rays downwards.
    """

    parameter: Array
    part: NDArray[np.int16]
    right: Array
    down: Array

    def distance(self) -> Array:
        """Return ``(h, w)`` distances along the rays, world units, ``inf`` where nothing is hit."""
        return np.asarray(self.parameter * np.sqrt(1 + self.right**2 + self.down[:, None] ** 2))


def cast(
    pose: Array, intrinsics: Array, columns: Array, rows: Array, parts: Sequence[Part] | None = None
) -> Hits:
    """Cast the rays through pixel coordinates ``columns`` x ``rows`` (a pixel's centre is at + 0.5).

    Args:
        pose: ``(4, 4)`` camera-to-world, camera looking along -z.
        intrinsics: ``(4,)`` fx, fy, cx, cy in pixels.
        columns: ``(w,)`` increasing.
        rows: ``(h,)`` increasing.
        parts: what there is to hit; None: the lighthouse.
    """
    fx, fy, cx, cy = intrinsics
    right = (columns - cx) / fx
    down = (rows - cy) / fy
    parameter = np.full((len(rows), len(columns)), np.inf)
    part_hit = np.full(parameter.shape, -1, dtype=np.int16)
    for number, part in enumerate(lighthouse() if parts is None else parts):
        window = _window(part, pose, right, down)
        if window is None:
            continue
        turn = part.axes.T @ pose[:3, :3]
        direction = (
            turn[:, 0, None, None] * right[window[1]]
            - turn[:, 1, None, None] * down[window[0], None]
            - turn[:, 2, None, None]
        )
        origin = part.axes.T @ (pose[:3, 3] - part.origin)
        t = part.solid.intersect(origin, direction)
        nearer = t < parameter[window]
        parameter[window][nearer] = t[nearer]
        part_hit[window][nearer] = number
    return Hits(parameter, part_hit, right, down)


def _window(part: Part, pose: Array, right: Array, down: Array) -> tuple[slice, slice] | None:
    """Return the rows and columns whose rays can meet the ball around a part, or None for none."""
    centre = pose[:3, :3].T @ (part.world(np.array([part.solid.middle]))[0] - pose[:3, 3])
    slices = []
    for axis, coordinates in ((1, down), (0, right)):
        across = centre[axis] if axis == 0 else -centre[axis]
        distance = float(np.hypot(across, centre[2]))
        if distance <= part.solid.reach:
            slices.append(slice(0, len(coordinates)))
            continue
        middle = np.arctan2(across, -centre[2])
        spread = np.arcsin(part.solid.reach / distance)
        if middle - spread <= -np.pi / 2 or middle + spread >= np.pi / 2:
            slices.append(slice(0, len(coordinates)))
            continue
        edges = np.searchsorted(coordinates, [np.tan(middle - spread), np.tan(middle + spread)])
        slices.append(slice(int(edges[0]), int(edges[1])))
    window = (slices[0], slices[1])
    return None if any(s.start >= s.stop for s in window) else window


def render_rgba(pose: Array, intrinsics: Array, width: int, height: int, *, samples: int = 3) -> Array:
    """Render ``(height, width, 4)`` straight-alpha RGBA in [0, 1], ``samples x samples`` rays per pixel."""
    columns = (np.arange(width * samples) + 0.5) / samples
    rows = (np.arange(height * samples) + 0.5) / samples
    hits = cast(pose, intrinsics, columns, rows)
    found, colour = hit_colours(hits, pose, lighthouse())
    row, column = np.divmod(found, width * samples)
    pixel = (row // samples) * width + column // samples
    covered = np.bincount(pixel, minlength=width * height)
    channels = [
        np.bincount(pixel, weights=colour[:, c], minlength=width * height) / np.maximum(covered, 1)
        for c in range(3)
    ]
    return np.stack([*channels, covered / samples**2], axis=-1).reshape(height, width, 4)


def hit_colours(hits: Hits, pose: Array, parts: Sequence[Part]) -> tuple[NDArray[np.int64], Array]:
    """Return the flat indices of rays that hit something, and their ``(N, 3)`` colours in [0, 1]."""
    found = np.flatnonzero(hits.part >= 0)
    found = found[np.argsort(hits.part.ravel()[found], kind="stable")]
    row, column = np.divmod(found, hits.part.shape[1])
    slopes = np.stack([hits.right[column], -hits.down[row], -np.ones(len(found))], axis=-1)
    rays = rotate(slopes, pose[:3, :3].T)
    points = pose[:3, 3] + hits.parameter.ravel()[found, None] * rays
    to_camera = -rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    colour = np.empty((len(found), 3))
    starts = np.searchsorted(hits.part.ravel()[found], np.arange(len(parts) + 1))
    for number, part in enumerate(parts):
        of_part = slice(starts[number], starts[number + 1])
        local = part.local(points[of_part])
        normals = rotate(part.solid.normal(local), part.axes.T)
        colour[of_part] = shade(part.material, local, normals, to_camera[of_part])
    return found, colour
