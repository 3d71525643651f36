"""Bounds of a scene: near, far and bounding box, by convention or from the cameras."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.views import IN_PLACE, Scene, World

__all__ = [
    "ADVICE",
    "HALF_EDGE",
    "Extent",
    "blender_extent",
    "box_is_seen",
    "camera_extent",
    "centred",
    "check_box",
    "focus_point",
    "points_extent",
    "points_seen",
    "settled",
]


ADVICE = "give bounds, near and far (gridreg prepare with --box, --near and --far)"
"""Way out for cameras from which no box follows."""

HALF_EDGE = 1.3
"""Half the edge of the box, in units of the scene, at which the presets are at home."""


class Extent(NamedTuple):
    """Near and far in world units along a ray, and a ``(2, 3)`` box."""

    near: float
    far: float
    bounds: NDArray[np.float64]


def focus_point(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ``(3,)`` point nearest to all optical axes in the least-squares sense.

    Directions along which the axes leave it open (parallel cameras) keep the mean camera position.
    """
    origins, axes = poses[:, :3, 3], -poses[:, :3, 2]
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    centre = origins.mean(axis=0)
    shift = (projectors @ (origins - centre)[:, :, None]).sum(axis=0)[:, 0]
    return np.asarray(centre + np.linalg.lstsq(projectors.sum(axis=0), shift, rcond=1e-6)[0])


def camera_extent(
    poses: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int]
) -> Extent:
    """Derive the box from cameras that look at a common object.

    The box is a cube around the focus point, as wide as the widest image sees at the focus.

    Args:
        poses: ``(V, 4, 4)`` camera-to-world.
        intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels.
        size: width and height of the images in pixels.

    Raises:
        InputError: when the cameras look away from each other, so that nothing lies before all of them.
    """
    centre = focus_point(poses)
    depth = ((centre - poses[:, :3, 3]) * -poses[:, :3, 2]).sum(axis=-1)
    behind = int((depth <= 1e-6).sum())
    if behind:
        raise InputError(
            f"cameras: {behind} of {len(poses)} look away from the point that the others look at; {ADVICE}"
        )
    half = float((depth * 0.5 * np.maximum(size[0] / intrinsics[:, 0], size[1] / intrinsics[:, 1])).max())
    distance = np.linalg.norm(centre - poses[:, :3, 3], axis=-1)
    near = max(0.05 * float(distance.min()), float(distance.min()) - half * 3**0.5)
    far = float(distance.max()) + half * 3**0.5
    return Extent(near, far, np.stack([centre - half, centre + half]))


def blender_extent(
    poses: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int]
) -> Extent:
    """Return the convention of nerf_synthetic where its cameras are met, else what the cameras say.

    Near 2, far 6 and the cube [-1.5, 1.5]^3 hold when every camera is 3 to 5 units from the origin and looks
    at it to within half a unit; official scenes have radius 4.03.
    """
    origins, axes = poses[:, :3, 3], -poses[:, :3, 2]
    radius = np.linalg.norm(origins, axis=-1)
    along = -(origins * axes).sum(axis=-1)
    miss = np.linalg.norm(origins + along[:, None] * axes, axis=-1)
    if bool(((radius >= 3) & (radius <= 5) & (along > 0) & (miss <= 0.5)).all()):
        return Extent(2.0, 6.0, np.array([[-1.5] * 3, [1.5] * 3]))
    return camera_extent(poses, intrinsics, size)


def points_extent(poses: NDArray[np.float64], points: NDArray[np.float64]) -> Extent:
    """Derive the box from points known to lie on surfaces, such as those of structure from motion.

    The box holds the middle 99 % of them along each axis and, on every side, 20 % of its longest edge more;
    near and far are the least and greatest distances at which cameras see points of the box, with a tenth of
    slack.

    Args:
        poses: ``(V, 4, 4)`` camera-to-world.
        points: ``(P, 3)`` world.

    Raises:
        InputError: when no camera has a point before it.
    """
    low, high = np.quantile(points, [0.005, 0.995], axis=0)
    # The same on every side: slender and plain parts that points miss may stick out of any of them.
    apart = np.linalg.norm(poses[:, :3, 3] - points.mean(axis=0), axis=-1)
    margin = max(0.2 * float((high - low).max()), 0.01 * float(apart.max()))
    bounds = np.stack([low - margin, high + margin])
    inside = points[((points >= bounds[0]) & (points <= bounds[1])).all(axis=1)]
    # One camera after the other, and of all distances the smallest alone: pairs of points and cameras fill
    # the memory.
    few = int(0.001 * len(inside) * len(poses)) + 2
    smallest, largest, count = np.empty(0), 0.0, 0
    for pose in poses:
        offset = inside - pose[:3, 3]
        distance = np.linalg.norm(offset, axis=-1)[offset @ -pose[:3, 2] > 0]
        count, largest = count + len(distance), max(largest, float(distance.max(initial=0.0)))
        if len(smallest) == few:
            distance = distance[distance < smallest.max()]
        smallest = np.concatenate([smallest, distance])
        if len(smallest) > few:
            smallest = np.partition(smallest, few - 1)[:few]
    if not count:
        raise InputError(f"cameras: none has a point of the model before it; {ADVICE}")
    # The quantile 0.001 of them all, as np.quantile interpolates it.
    smallest.sort()
    below, fraction = divmod(0.001 * (count - 1), 1)
    low, high = smallest[int(below)], smallest[min(int(below) + 1, count - 1)]
    return Extent(0.9 * float(low + (high - low) * fraction), 1.1 * largest, bounds)


def settled(extent: Extent) -> tuple[World, Extent]:
    """Return the world in which an extent is at home, and the extent there.

    A box about as large as those of the presets, and about the origin, stays where it is, bit for bit; any
    other is :func:`centred`.
    """
    middle = extent.bounds.mean(axis=0)
    half = float((extent.bounds[1] - middle).max())
    at_home = HALF_EDGE / 2 <= half <= 2 * HALF_EDGE and float(np.abs(middle).max()) <= half
    return (IN_PLACE, extent) if at_home else centred(extent)


def centred(extent: Extent) -> tuple[World, Extent]:
    """Return the world whose origin is a box's middle and in which the box reaches 1.3, and the extent
    there."""
    x, y, z = extent.bounds.mean(axis=0).tolist()
    unit = float((extent.bounds[1] - (x, y, z)).max()) / HALF_EDGE
    if not 0 < unit < np.inf:
        return IN_PLACE, extent
    return World((x, y, z), unit), Extent(
        extent.near / unit, extent.far / unit, (extent.bounds - (x, y, z)) / unit
    )


def check_box(scene: Scene, points: NDArray[np.float64] | None = None) -> None:
    """Make sure that the scene's box can hold something.

    Args:
        scene: whose box, near and far are checked against its training cameras.
        points: ``(P, 3)`` points of which the box must hold at least one.

    Raises:
        InputError: when no training camera sees the box between near and far, or it holds none of the points.
    """
    bounds = scene.bounds.numpy().astype(np.float64)
    low, high = bounds
    if points is not None and not ((points >= low) & (points <= high)).all(axis=1).any():
        raise InputError(
            f"bounds: the box {scene.bounds.tolist()} holds none of the scene's {len(points)} points"
        )
    if scene.ndc or not len(scene.train):
        return
    poses, intrinsics = scene.train.poses.numpy(), scene.train.intrinsics.numpy()
    extent = Extent(scene.near, scene.far, bounds)
    if not box_is_seen(extent, poses, intrinsics, (scene.train.width, scene.train.height)):
        raise InputError(
            f"bounds: no training camera sees the box {scene.bounds.tolist()} between "
            f"near {scene.near:g} and far {scene.far:g}"
        )


def box_is_seen(
    extent: Extent, poses: NDArray[np.float64], intrinsics: NDArray[np.float64], size: tuple[int, int]
) -> bool:
    """Tell whether any camera sees some of a box between near and far.

    Args:
        extent: the box, near and far.
        poses: ``(V, 4, 4)`` camera-to-world.
        intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels.
        size: width and height of the images in pixels.
    """
    low, high = extent.bounds
    steps = np.linspace(0, 1, 9)
    grid = low + np.stack(np.meshgrid(steps, steps, steps), axis=-1).reshape(-1, 3) * (high - low)
    return any(
        _sees_points(grid, pose, values, extent, size) or _meets_box(pose, values, extent, size)
        for pose, values in zip(poses, intrinsics, strict=True)
    )


def _sees_points(
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
    values: NDArray[np.float64],
    extent: Extent,
    size: tuple[int, int],
) -> bool:
    """Tell whether any of the points lies in the image, between near and far: finds small boxes."""
    return bool(points_seen(points, pose, values, extent, size).any())


def points_seen(
    points: NDArray[np.float64],
    pose: NDArray[np.float64],
    values: NDArray[np.float64],
    extent: Extent,
    size: tuple[int, int],
) -> NDArray[np.bool_]:
    """Tell of each point whether it lies in the image, between near and far."""
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    depth = -local[:, 2]
    safe = np.maximum(depth, 1e-9)
    column = local[:, 0] / safe * values[0] + values[2]
    row = -local[:, 1] / safe * values[1] + values[3]
    distance = np.linalg.norm(local, axis=-1)
    seen = (depth > 0) & (distance >= extent.near) & (distance <= extent.far)
    seen &= (column >= 0) & (column <= size[0]) & (row >= 0) & (row <= size[1])
    return np.asarray(seen)


def _meets_box(
    pose: NDArray[np.float64], values: NDArray[np.float64], extent: Extent, size: tuple[int, int]
) -> bool:
    """Tell whether a ray of a coarse grid of pixels meets the box between near and far: finds large boxes."""
    low, high = extent.bounds
    columns, rows = np.meshgrid(np.linspace(0, size[0], 17), np.linspace(0, size[1], 17))
    local = np.stack(
        [(columns - values[2]) / values[0], -(rows - values[3]) / values[1], -np.ones_like(rows)], axis=-1
    ).reshape(-1, 3)
    direction = local / np.linalg.norm(local, axis=-1, keepdims=True) @ pose[:3, :3].T
    inverse = 1 / np.where(np.abs(direction) < 1e-9, 1e-9, direction)
    a, b = (low - pose[:3, 3]) * inverse, (high - pose[:3, 3]) * inverse
    entry = np.maximum(np.minimum(a, b).max(axis=-1), extent.near)
    leave = np.minimum(np.maximum(a, b).min(axis=-1), extent.far)
    return bool((entry < leave).any())
