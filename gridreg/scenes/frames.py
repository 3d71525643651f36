"""Frames: what a reader knows about a view before its image is opened."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError

__all__ = ["Camera", "Frame", "SceneFiles", "check_pose", "resolve_inside"]

_EXTENSIONS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


@dataclass(frozen=True)
class Camera:
    """Intrinsics as a file states them; what it leaves out follows from the image's size.

    Attributes:
        angle_x: horizontal field of view in radians, used when ``fx`` is not given.
        fx, fy: focal lengths in pixels; ``fy`` defaults to ``fx``.
        cx, cy: principal point in pixels; defaults to the image's centre.
        width, height: size in pixels, checked against the image when given.
    """

    angle_x: float | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    width: int | None = None
    height: int | None = None

    def intrinsics(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Return ``(fx, fy, cx, cy)`` in pixels for an image of this size."""
        fx = self.fx
        if fx is None:
            if self.angle_x is None:
                raise InputError("camera: neither fl_x nor camera_angle_x is given")
            fx = 0.5 * width / math.tan(0.5 * self.angle_x)
        fy = fx if self.fy is None else self.fy
        cx = 0.5 * width if self.cx is None else self.cx
        cy = 0.5 * height if self.cy is None else self.cy
        return fx, fy, cx, cy


@dataclass(frozen=True)
class Frame:
    """One view of a frame list.

    Attributes:
        file_path: path as the file states it, relative to the scene folder, perhaps without extension.
        pose: ``(4, 4)`` camera-to-world.
        camera: its intrinsics.
        where: file and frame number, for messages.
    """

    file_path: str
    pose: NDArray[np.float64]
    camera: Camera
    where: str


@dataclass(frozen=True)
class SceneFiles:
    """Frame lists of a scene folder, unopened.

    Attributes:
        folder: the scene folder.
        train, test: frame lists that protocols index.
        sources: the file behind each list, for messages.
    """

    folder: Path
    train: list[Frame]
    test: list[Frame]
    sources: dict[str, Path]


def check_pose(matrix: object, where: str) -> NDArray[np.float64]:
    """Return a camera-to-world matrix as ``(4, 4)`` float64, or say what is wrong with it.

    Raises:
        InputError: unless it is 4x4 (or 3x4) numbers, finite, with a rotation and the last row 0 0 0 1.
    """
    try:
        pose = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise InputError(f"{where}: transform_matrix is not a 4x4 matrix of numbers") from None
    if pose.shape == (3, 4):
        pose = np.concatenate([pose, [[0.0, 0.0, 0.0, 1.0]]])
    if pose.shape != (4, 4):
        raise InputError(f"{where}: transform_matrix has shape {pose.shape}, expected (4, 4)")
    if not np.isfinite(pose).all():
        raise InputError(f"{where}: transform_matrix holds a number that is not finite")
    rotation = pose[:3, :3]
    if np.abs(rotation).max() > 2 or np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-3:
        raise InputError(f"{where}: transform_matrix is not rigid, expected a rotation in its upper left 3x3")
    if np.linalg.det(rotation) < 0:
        raise InputError(f"{where}: transform_matrix mirrors, expected a rotation in its upper left 3x3")
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise InputError(f"{where}: transform_matrix has the last row {pose[3].tolist()}, expected 0 0 0 1")
    return pose


def resolve_inside(folder: Path, file_path: str, where: str) -> Path:
    """Find the file that a frame names, with or without extension, inside ``folder`` and nowhere else.

    Raises:
        InputError: when there is no such file, or it lies outside the folder, symbolic links followed.
    """
    stated = Path(file_path)
    root = folder.resolve()
    if not file_path or "\0" in file_path or stated.is_absolute():
        raise InputError(f"{where}: file_path {file_path!r} is not a path relative to the scene folder")
    candidates = [root / stated, *(root / f"{file_path}{extension}" for extension in _EXTENSIONS)]
    for candidate in candidates:
        try:
            resolved = candidate.resolve()
            # Containment comes first: a path that climbs out must not even tell whether something is there.
            if not resolved.is_relative_to(root):
                raise InputError(f"{where}: file_path {file_path!r} leads out of the scene folder {folder}")
            if resolved.is_file():
                return resolved
        except (OSError, RuntimeError):
            raise InputError(f"{where}: file_path {file_path!r} cannot be followed") from None
    raise InputError(f"{where}: image {folder / stated} not found")
