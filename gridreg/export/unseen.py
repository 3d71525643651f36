"""Space behind surfaces that no camera sees into: there an object is taken to be solid."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]

from gridreg.export.volume import DensityVolume
from gridreg.rendering import Camera, Lens, OccupancyGrid

_MARGIN = 2.0
"""Nodes behind a surface up to which space counts as seen: slanted ones are met between nodes."""
_SPLAT = 3
"""Edge of what a node covers of an image that has a pixel for it: there are no gaps between neighbours."""


def fill_unseen(
    volume: DensityVolume,
    threshold: float,
    cameras: Sequence[Camera],
    occupancy: OccupancyGrid,
    *,
    standing: bool = False,
) -> DensityVolume:
    """Return how far each node is filled as no camera sees it, in [0, 1]: at 1/2 the filled space ends.

    The hull of silhouettes bounds it (space carving: what no camera proves empty is matter, Kutulakos and Seitz 2000).
    The surface at the threshold hides what is behind it. Nothing is filled beyond the extent of what is seen.

    Args:
        volume: densities.
        threshold: density per world unit at the surface.
        cameras: that the field was trained on, in its coordinates.
        occupancy: with the hull of their silhouettes.
        standing: whether the object stands on what the lattice ends at below (z), so that it reaches down to there.
    """
    assert occupancy.hull is not None
    solid = volume.values >= threshold
    hull = OccupancyGrid(occupancy.bounds, occupancy.hull)
    spacing = float(volume.spacing.max())

    def place(index: NDArray[np.int64]) -> NDArray[np.float64]:
        return np.asarray(volume.lower + index * volume.spacing)

    index = np.argwhere(solid & ~ndimage.binary_erosion(solid, border_value=1))
    surface = place(index)
    views = [_view(surface, camera, spacing) for camera in cameras if len(surface)]
    known = np.zeros(len(index), dtype=bool)
    for sees in views:
        known |= sees(surface)
    unseen = np.zeros_like(solid)
    if known.any():
        # Below what is seen at all, a hull only narrows as steeply as the lowest camera looks.
        low, high = index[known].min(axis=0), index[known].max(axis=0)
        low[2] *= not standing
        for i in range(low[0], high[0] + 1):
            # A layer at a time: positions of all nodes would take more memory than the lattice.
            nodes = np.argwhere(~solid[i : i + 1, low[1] : high[1] + 1, low[2] : high[2] + 1])
            nodes += (i, low[1], low[2])
            nodes = nodes[hull.contains(torch.from_numpy(place(nodes)).to(hull.bounds)).cpu().numpy()]
            for sees in views:
                nodes = nodes[~sees(place(nodes))]
            unseen[tuple(nodes.T)] = True
    whole = unseen | solid
    # Slivers between two surfaces are no matter.
    unseen &= ndimage.binary_opening(whole, np.ones((3, 3, 3), dtype=bool))
    soft = ndimage.gaussian_filter(whole.astype(np.float32), 1.0)
    soft[~ndimage.binary_dilation(unseen, iterations=2)] = 0
    return DensityVolume(soft, volume.lower, volume.spacing)


def _view(
    surface: NDArray[np.float64], camera: Camera, spacing: float
) -> Callable[[NDArray[np.float64]], NDArray[np.bool_]]:
    """Return what tells whether a camera sees positions ``(N, 3)`` past the nodes of a surface, ``(N,)``."""
    pose = camera.pose.double().cpu().numpy()
    distance = max(spacing, float(np.linalg.norm(surface.mean(axis=0) - pose[:3, 3])))
    # A pixel for a node, as far as the image has as many.
    pixels = camera.lens.width * distance / (spacing * camera.lens.intrinsics[0])
    lens = camera.lens.resized(max(8, min(camera.lens.width, round(pixels))))
    rows, columns, depth, within = _projected(surface, pose, lens)
    nearest = np.full((lens.height, lens.width), np.inf)
    np.minimum.at(nearest, (rows[within], columns[within]), depth[within])
    nearest = ndimage.minimum_filter(nearest, _SPLAT)

    def sees(positions: NDArray[np.float64]) -> NDArray[np.bool_]:
        rows, columns, depth, within = _projected(positions, pose, lens)
        return np.asarray(within & (depth < nearest[rows, columns] + _MARGIN * spacing))

    return sees


def _projected(
    points: NDArray[np.float64], pose: NDArray[np.float64], lens: Lens
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.bool_]]:
    """Row, column and depth of points ``(N, 3)``, and whether they are in the image."""
    fx, fy, cx, cy = lens.intrinsics
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = -local[:, 2]
    safe = np.where(depth > 1e-9, depth, 1.0)
    columns, rows = np.floor(cx + fx * local[:, 0] / safe), np.floor(cy - fy * local[:, 1] / safe)
    within = (depth > 1e-9) & (columns >= 0) & (columns < lens.width) & (rows >= 0) & (rows < lens.height)
    rows, columns = (np.where(within, each, 0).astype(np.int64) for each in (rows, columns))
    return rows, columns, depth, within
