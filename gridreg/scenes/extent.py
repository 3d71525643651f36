"""Where to look: near, far and bounding box, by convention or from the cameras."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError

__all__ = ["Extent", "blender_extent", "camera_extent", "focus_point"]


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
            f"cameras: {behind} of {len(poses)} look away from the point that the "
            "others look at; give bounds, near and far"
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
