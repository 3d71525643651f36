"""Frames: what a reader knows about a view before its image is opened."""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.extent import Extent
from gridreg.scenes.files import find_inside
from gridreg.scenes.lens import NO_DISTORTION, LensDistortion

__all__ = ["Frame", "SceneFiles", "StatedIntrinsics", "camera_keys"]


@dataclass(frozen=True)
class StatedIntrinsics:
    """Intrinsics as a file states them; what it leaves out follows from the image's size.

    Attributes:
        angle_x: horizontal field of view in radians, used when ``fx`` is not given.
        fx, fy: focal lengths in pixels; ``fy`` defaults to ``fx``.
        cx, cy: principal point in pixels; defaults to the image's centre.
        width, height: size in pixels, checked against the image when given; a fraction of a pixel is left
            aside.
        distortion: of the lens.
    """

    angle_x: float | None = None
    fx: float | None = None
    fy: float | None = None
    cx: float | None = None
    cy: float | None = None
    width: float | None = None
    height: float | None = None
    distortion: LensDistortion = NO_DISTORTION

    @property
    def size(self) -> tuple[float, float] | None:
        """Width and height, when both are given."""
        return None if self.width is None or self.height is None else (self.width, self.height)

    @property
    def fingerprint(self) -> str:
        """Text that stands for these intrinsics in a scene's fingerprint; checkpoints hold it, so it never
        changes."""
        text = str(self).replace("LensDistortion(", "Distortion(")
        return text.replace("StatedIntrinsics(", "Camera(")

    def intrinsics(self, width: int, height: int) -> tuple[float, float, float, float]:
        """Return ``(fx, fy, cx, cy)`` in pixels for an image of this size."""
        fx = self.fx
        if fx is None:
            if self.angle_x is None:
                raise InputError("camera: neither fl_x nor camera_angle_x is given")
            fx = 0.5 * width / math.tan(0.5 * self.angle_x)
        elif self.angle_x is not None and self.width is None:
            meant = 2 * fx * math.tan(0.5 * self.angle_x)
            if abs(meant - width) > 0.05 * width:
                raise InputError(
                    f"camera: fl_x and camera_angle_x belong to images {meant:.0f} wide, found {width} "
                    "(intrinsics of another size?)"
                )
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
        metric: whether the stated extent is in metres, so that its world is to be scaled.
        ndc: whether rays are to be mapped to normalised device coordinates.
        split_here: whether the format has one list and the test frames were held out of it by this reader.
        own_split: whether the files name the test frames themselves.
        notes: what a user should know about how the files were understood, a line each.
    """

    folder: Path
    train: list[Frame]
    test: list[Frame]
    sources: dict[str, Path]
    opaque: bool = False
    as_stored: bool = False
    points: NDArray[np.float64] | None = None
    extent: Extent | None = None
    metric: bool = False
    ndc: bool = False
    split_here: bool = False
    own_split: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        without = [frame for frame in (*self.train, *self.test) if frame.mask_path is None]
        if 0 < len(without) < len(self.train) + len(self.test):
            raise InputError(
                f"{without[0].where}: has no mask, others have; expected one for every frame, or none"
            )

    @staticmethod
    def held_out(
        folder: Path,
        frames: list[Frame],
        source: Path,
        *,
        test: Collection[str] = (),
        notes: tuple[str, ...] = (),
        **options: Any,
    ) -> SceneFiles:
        """Split one list: every eighth frame from the first is for testing (LLFF's convention), the others
        train.

        Frames whose images are not there are left out, and a note says so.

        Args:
            folder: the scene folder.
            frames: the list.
            source: the file that it comes from.
            test: paths of the frames to hold out instead of every eighth.
            notes: what there is to say already.
            options: further attributes.

        Raises:
            InputError: for fewer than two frames with images, or no frame left on one side.
        """
        missing = [frame for frame in frames if find_inside(folder, frame.file_path, frame.where) is None]
        if missing:
            example = f"image {folder / missing[0].file_path} not found"
            if len(missing) > len(frames) - 2:
                raise InputError(
                    f"{missing[0].where}: {example} (nor {len(missing) - 1} more of {len(frames)})"
                )
            notes += (
                f"{source}: {len(missing)} of {len(frames)} frames have no image and are left out ({example})",
            )
            gone = {id(frame) for frame in missing}
            frames = [frame for frame in frames if id(frame) not in gone]
        if len(frames) < 2:
            raise InputError(f"{source}: found {len(frames)} frames, expected at least 2 (one is held out)")
        held = [frame.file_path in test if test else i % 8 == 0 for i, frame in enumerate(frames)]
        train = [frame for frame, out in zip(frames, held, strict=True) if not out]
        rest = [frame for frame, out in zip(frames, held, strict=True) if out]
        if not train or not rest:
            raise InputError(
                f"{source}: its own split leaves {len(train)} training and {len(rest)} test frames with images"
            )
        sources = {"train": source, "test": source}
        return SceneFiles(
            folder, train, rest, sources, split_here=True, own_split=bool(test), notes=notes, **options
        )


def camera_keys(camera: StatedIntrinsics, size: tuple[int, int], reduced: tuple[int, int]) -> dict[str, Any]:
    """Return the keys of a camera for images of ``size`` that are now ``reduced``."""
    fx, fy, cx, cy = camera.intrinsics(*size)
    x, y = reduced[0] / size[0], reduced[1] / size[1]
    lens = {key: value for key, value in asdict(camera.distortion).items() if value}
    return {
        "w": reduced[0],
        "h": reduced[1],
        "fl_x": fx * x,
        "fl_y": fy * y,
        "cx": cx * x,
        "cy": cy * y,
        **lens,
    }
