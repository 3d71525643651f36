"""Frames: what a reader knows about a view before its image is opened."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.extent import Extent
from gridreg.scenes.lens import NO_DISTORTION, LensDistortion

__all__ = ["StatedIntrinsics", "Frame", "SceneFiles", "check_pose", "resolve_inside"]

_EXTENSIONS = (".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")


@dataclass(frozen=True)
class StatedIntrinsics:
    """Intrinsics as a file states them; what it leaves out follows from the image's size.

    Attributes:
        angle_x: horizontal field of view in radians, used when ``fx`` is not given.
        fx, fy: focal lengths in pixels; ``fy`` defaults to ``fx``.
        cx, cy: principal point in pixels; defaults to the image's centre.
        width, height: size in pixels, checked against the image when given.
        distortion: of the lens.
    """

    angle_x: float | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    width: int | None = None
    height: int | None = None
    distortion: LensDistortion = NO_DISTORTION

    @property
    def size(self) -> tuple[int, int] | None:
        """Width and height, when both are given."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def fingerprint(self) -> str:
        """Text that stands for these intrinsics in a scene's fingerprint; checkpoints hold it, so it never changes."""
        text = str(self).replace("LensDistortion(", "Distortion(")
        return text.replace("StatedIntrinsics(", "Camera(")

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
        mask_path: path of a mask that becomes alpha, relative to the scene folder.
    """

    file_path: str
    pose: NDArray[np.float64]
    camera: StatedIntrinsics
    where: str
    mask_path: str | None = None


@dataclass(frozen=True)
class SceneFiles:
    """Frame lists of a scene folder, unopened.

    Attributes:
        folder: the scene folder.
        train, test: frame lists that protocols index.
        sources: the file behind each list, for messages.
        opaque: whether images without alpha are what the format is made for.
        as_stored: whether cameras belong to images as they are stored, whatever EXIF says of their
            orientation.
        points: ``(P, 3)`` points known to lie on surfaces, world.
        extent: near, far and box, where the format states them.
        ndc: whether rays are to be mapped to normalised device coordinates.
        split_here: whether the format has one list and the test frames were held out of it by this reader.
    """

    folder: Path
    train: list[Frame]
    test: list[Frame]
    sources: dict[str, Path]
    opaque: bool = False
    as_stored: bool = False
    points: NDArray[np.float64] | None = None
    extent: Extent | None = None
    ndc: bool = False
    split_here: bool = False

    @staticmethod
    def held_out(folder: Path, frames: list[Frame], source: Path, **options: Any) -> SceneFiles:
        """Split one list: every eighth frame from the first is for testing (LLFF's convention), the others
        train.

        Raises:
            InputError: for fewer than two frames.
        """
        if len(frames) < 2:
            raise InputError(f"{source}: found {len(frames)} frames, expected at least 2 (one is held out)")
        train = [frame for i, frame in enumerate(frames) if i % 8]
        return SceneFiles(
            folder, train, frames[::8], {"train": source, "test": source}, split_here=True, **options
        )


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
