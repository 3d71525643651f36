"""A drawing of the cameras of a scene, the box that holds it, and what is known of its surface."""

from __future__ import annotations

import os
from itertools import combinations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.machine import temporary_beside

__all__ = ["draw_cameras"]

Array = NDArray[np.float64]


def draw_cameras(
    path: str | Path,
    poses: Array,
    intrinsics: Array,
    size: tuple[int, int],
    bounds: Array,
    *,
    points: Array | None = None,
) -> None:
    """Write a PNG with two views, from the side and from above: cameras as pyramids, the box as a wireframe.

    Args:
        path: the PNG to write.
        poses: ``(V, 4, 4)`` camera-to-world.
        intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels.
        size: width and height of the images in pixels.
        bounds: ``(2, 3)`` lower and upper corner.
        points: ``(P, 3)`` points on surfaces; at most 3000 of them are drawn.

    Raises:
        InputError: when the file cannot be written.
    """
    # Imported here, so that reading a scene costs no plotting library; pyplot would leave state behind.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5.5), layout="constrained")
    FigureCanvasAgg(figure)
    origins = poses[:, :3, 3]
    reach = float(np.abs(np.concatenate([origins, bounds]) - bounds.mean(axis=0)).max())
    pyramids = [
        _pyramid(pose, values, size, 0.12 * reach) for pose, values in zip(poses, intrinsics, strict=True)
    ]
    shown = None if points is None else points[:: max(1, len(points) // 3000)]
    for place, (elevation, title) in enumerate(((18, "from the side"), (89, "from above")), start=1):
        axes = figure.add_subplot(1, 2, place, projection="3d")
        for line in _box_edges(bounds):
            axes.plot(*line.T, color="tab:red", linewidth=1)
        for pyramid in pyramids:
            axes.plot(*pyramid.T, color="tab:blue", linewidth=0.8)
        if shown is not None and len(shown):
            axes.scatter(*shown.T, s=1, color="tab:gray", depthshade=False)
        centre = bounds.mean(axis=0)
        axes.set(
            xlim=(centre[0] - reach, centre[0] + reach),
            ylim=(centre[1] - reach, centre[1] + reach),
            zlim=(centre[2] - reach, centre[2] + reach),
            xlabel="x",
            ylabel="y",
            zlabel="z",
            title=f"{len(poses)} cameras (blue) and the box (red), {title}",
        )
        axes.set_box_aspect((1, 1, 1))
        axes.view_init(elev=elevation, azim=-70)
    path = Path(path)
    beside = temporary_beside(path)
    try:
        figure.savefig(beside, dpi=100, format="png")
        os.replace(beside, path)
    except OSError as error:
        beside.unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written ({error.strerror})") from None


def _pyramid(pose: Array, intrinsics: Array, size: tuple[int, int], depth: float) -> Array:
    """Return a ``(N, 3)`` polyline that draws a camera as a pyramid of this depth."""
    fx, fy, cx, cy = intrinsics
    left, right = -cx / fx, (size[0] - cx) / fx
    top, bottom = cy / fy, -(size[1] - cy) / fy
    corners = depth * np.array([[left, top, -1], [right, top, -1], [right, bottom, -1], [left, bottom, -1]])
    apex = np.zeros(3)
    order = [apex, corners[0], corners[1], apex, corners[2], corners[3], apex]
    order += [corners[0], corners[3], corners[2], corners[1]]
    return np.asarray(np.array(order) @ pose[:3, :3].T + pose[:3, 3])


def _box_edges(bounds: Array) -> list[Array]:
    """Return the twelve edges of a box, ``(2, 3)`` each."""
    corners = np.array(list(product(*bounds.T)))
    pairs = combinations(corners, 2)
    return [np.stack(pair) for pair in pairs if (pair[0] != pair[1]).sum() == 1]
