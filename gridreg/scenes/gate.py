"""Gate for numbers: poses, intrinsics, distances and boxes that float32 can hold and rays can be made of.

Everything that becomes `gridreg.scenes.Views` or `gridreg.scenes.Scene` passes here once it is float32,
whatever format it came in; camera files and other readers call the same functions.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gridreg.errors import InputError

__all__ = ["check_cameras", "check_extent", "check_pose", "check_spread"]

Array = NDArray[np.float64]

# Rotations: how far from orthonormal. Written with four digits they still pass.
_RIGID = 1e-3
# Focal lengths in units of the image's edge: fields of view between 179.4 degrees and a hundredth of one.
_SHORTEST, _LONGEST = 0.005, 5e3
# Fraction of the box that neighbouring float32 numbers may be apart at the farthest camera or corner.
_COARSEST = 1e-3
_FLOAT32 = float(np.finfo(np.float32).eps)
# How many times wider than the room that the cameras take the box may be.
_WIDEST = 1e6
# How many times farther out than most cameras one may be.
_STRAY = 1e4


def check_pose(matrix: object, where: str) -> Array:
    """Return a camera-to-world matrix as ``(4, 4)`` float64, or say what is wrong with it.

    Raises:
        InputError: unless it is 4x4 (or 3x4) numbers, finite also in float32, with a rotation and the last
            row 0 0 0 1.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: transform_matrix is not a 4x4 matrix of numbers") from None
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if pose.shape != (4, 4):
        raise InputError(f"{where}: transform_matrix has shape {pose.shape}, expected (4, 4)")
    fault = _pose_fault(pose)
    if fault:
        raise InputError(f"{where}: transform_matrix {fault}")
    return pose


def _pose_fault(pose: Array) -> str | None:
    rotation = pose[:3, :3]
    if not np.isfinite(pose).all():
        return "holds a number that is not finite"
    if np.abs(rotation).max() > 2 or np.abs(rotation.T @ rotation - np.eye(3)).max() > _RIGID:
        return "is not rigid, expected a rotation in its upper left 3x3"
    if np.linalg.det(rotation) < 0:
        return "mirrors, expected a rotation in its upper left 3x3"
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        return f"has the last row {pose[3].tolist()}, expected 0 0 0 1"
    # The largest float32 squares to more than it can hold: a distance to it would be infinite.
    if np.abs(pose).max() > 1e18:
        return f"places the camera at {pose[:3, 3].tolist()}, beyond what float32 can tell apart"
    return None


def check_cameras(
    poses: ArrayLike, intrinsics: ArrayLike, size: tuple[int, int], names: Sequence[str]
) -> None:
    """Make sure that every camera is rigid, right-handed and has a lens that its image can come from.

    Args:
        poses: ``(V, 4, 4)`` camera-to-world, as float32 has them.
        intrinsics: ``(V, 4)`` fx, fy, cx, cy in pixels, likewise.
        size: width and height of the images in pixels.
        names: ``V`` names of frames or views for messages.

    Raises:
        InputError: for the first camera that is not so.
    """
    for pose, (fx, fy, cx, cy), name in zip(
        np.asarray(poses, np.float64), np.asarray(intrinsics, np.float64), names, strict=True
    ):
        fault = _pose_fault(pose)
        if fault:
            raise InputError(f"{name}: pose {fault}")
        for focal, edge, axis in ((fx, size[0], "x"), (fy, size[1], "y")):
            if not _SHORTEST * edge < focal < _LONGEST * edge:
                raise InputError(
                    f"{name}: focal length {axis} is {focal:g} pixels, expected a positive number that fits "
                    f"an edge of {edge} pixels"
                )
        if not 0.1 < fx / fy < 10:
            raise InputError(f"{name}: focal lengths are {fx:g} and {fy:g} pixels, expected about the same")
        if not (0 < cx < size[0] and 0 < cy < size[1]):
            raise InputError(
                f"{name}: principal point ({cx:g}, {cy:g}) lies outside of the image of {size[0]}x{size[1]}; "
                "are the intrinsics those of another size?"
            )


def check_spread(positions: Array, names: Sequence[str]) -> None:
    """Make sure that no camera is so far away from the others that they would become one.

    Args:
        positions: ``(V, 3)`` in the world of the files.
        names: ``V`` names of frames for messages.

    Raises:
        InputError: for the farthest camera, if it is 10,000 times as far out as most.
    """
    if len(positions) < 3:
        return
    distance = np.abs(positions - np.median(positions, axis=0)).max(axis=1)
    usual, farthest = float(np.median(distance)), int(distance.argmax())
    if usual > 0 and distance[farthest] > _STRAY * usual:
        raise InputError(
            f"{names[farthest]}: camera is {distance[farthest]:.3g} from the others, which are within {usual:.3g}"
        )


def check_extent(near: float, far: float, bounds: ArrayLike, positions: ArrayLike = ()) -> None:
    """Make sure that distances and box are finite and ordered, and fine enough in float32 where cameras
    stand.

    Args:
        near: world units.
        far: world units.
        bounds: ``(2, 3)`` lower and upper corner.
        positions: ``(V, 3)`` cameras in the same world.

    Raises:
        InputError: naming the argument that is not so.
    """
    if not 0 <= near < far < 1e18:
        raise InputError(f"near, far: found {near:g} and {far:g}, expected 0 <= near < far")
    box = np.asarray(bounds, np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise InputError(f"bounds: found {box.tolist()}, expected (2, 3) with lower corner below upper")
    edge = float((box[1] - box[0]).min())
    cameras = np.asarray(positions, np.float64).reshape(-1, 3)
    apart = float(np.ptp(cameras, axis=0).max()) if len(cameras) else 0.0
    if 0 < apart < edge / _WIDEST:
        raise InputError(
            f"bounds: a box {edge:.3g} wide around cameras that stand {apart:.3g} apart, expected a smaller one"
        )
    for what, points in (("bounds", box), ("cameras", cameras)):
        reach = float(np.abs(points).max(initial=0.0))
        if not reach * _FLOAT32 < _COARSEST * edge:
            raise InputError(
                f"{what}: reach to {reach:.3g}, where float32 cannot tell apart what lies in a box {edge:.3g} wide"
            )
