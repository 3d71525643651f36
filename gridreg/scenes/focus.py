"""The box of photographs that show an object and what is around it: where their cameras look."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gridreg.scenes.extent import Extent, focus_point, points_seen

__all__ = ["focus_extent", "looks_at_focus", "surround_focus"]


def looks_at_focus(poses: NDArray[np.float64]) -> bool:
    """Tell whether nearly all cameras have the point before them that all of them look at."""
    offset = focus_point(poses) - poses[:, :3, 3]
    depth = (offset * -poses[:, :3, 2]).sum(axis=-1)
    return bool((depth > 0.2 * np.linalg.norm(offset, axis=-1) + 1e-6).mean() >= 0.9)


def surround_focus(poses: NDArray[np.float64]) -> bool:
    """Tell whether cameras stand on all sides of the point that they look at: no gap between them of half a turn.

    Sides are told apart about the cameras' mean up.

    Example:
        >>> poses = np.tile(np.eye(4), (4, 1, 1))
        >>> for pose, (x, y) in zip(poses, ((1, 0), (0, 1), (-1, 0), (0, -1)), strict=True):
        ...     pose[:3, :3] = np.array([[-y, 0, x], [x, 0, y], [0, 1, 0]])
        ...     pose[:3, 3] = 3 * pose[:3, 2]
        >>> surround_focus(poses), surround_focus(poses[:2])
        (True, False)
    """
    if not looks_at_focus(poses):
        return False
    up = poses[:, :3, 1].mean(axis=0)
    side = np.linalg.svd(up[None])[2][1:]
    x, y = side @ (poses[:, :3, 3] - focus_point(poses)).T
    angles = np.sort(np.arctan2(y, x))
    gaps = np.diff(np.append(angles, angles[0] + 2 * np.pi))
    return bool(gaps.max() < np.pi)


def focus_extent(
    poses: NDArray[np.float64],
    intrinsics: NDArray[np.float64],
    size: tuple[int, int],
    points: NDArray[np.float64] | None = None,
) -> Extent:
    """Derive the box from photographs of an object and what is around it: it is where the cameras look.

    About the focus point, the box holds what half of the cameras see, up to as far as the median image is wide there.
    Points in it may only make it smaller: it holds the middle 99 % of them and a tenth of its longest edge more. So
    neither a wall behind the object nor far points of it make the box larger. `surround_focus` must hold.

    Args:
        poses: ``(V, 4, 4)`` camera-to-world.
        intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels.
        size: width and height of the images in pixels.
        points: ``(P, 3)`` on surfaces, world.
    """
    origins, axes = poses[:, :3, 3], -poses[:, :3, 2]
    centre = focus_point(poses)
    depth = ((centre - origins) * axes).sum(axis=-1)
    wide = np.maximum(size[0] / intrinsics[:, 0], size[1] / intrinsics[:, 1]) / 2
    reach = float(np.median(depth * wide))
    steps = np.linspace(-reach, reach, 41)
    grid = centre + np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), axis=-1).reshape(-1, 3)
    seen = np.zeros(len(grid))
    for pose, values in zip(poses, intrinsics, strict=True):
        seen += points_seen(grid, pose, values, Extent(0.0, np.inf, grid[[0, -1]]), size)
    kept = grid[seen >= 0.5 * float(seen.max())]
    low, high = kept.min(axis=0), kept.max(axis=0)
    inside = np.empty((0, 3)) if points is None else points[((points >= low) & (points <= high)).all(axis=1)]
    if len(inside) >= 100:
        least, most = np.quantile(inside, [0.005, 0.995], axis=0)
        margin = 0.1 * float((most - least).max())
        low, high = np.maximum(low, least - margin), np.minimum(high, most + margin)
    distance = np.linalg.norm((low + high) / 2 - origins, axis=-1)
    half = float(np.linalg.norm(high - low)) / 2
    near = max(0.05 * float(distance.min()), float(distance.min()) - half)
    return Extent(near, float(distance.max()) + half, np.stack([low, high]))
