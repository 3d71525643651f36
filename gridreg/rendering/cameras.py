"""A camera: what a lens sees from a pose."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from gridreg.errors import InputError


@dataclass(frozen=True)
class Lens:
    """Intrinsics and size of a image.

    Args:
        intrinsics: fx, fy, cx, cy in pixels.
        height, width: pixels.
    """

    intrinsics: tuple[float, float, float, float]
    height: int
    width: int

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise InputError(f"size: found {self.width}x{self.height}, expected at least 1x1 pixels")
        if not (all(map(math.isfinite, self.intrinsics)) and min(self.intrinsics[:2]) > 0):
            raise InputError(
                f"intrinsics={self.intrinsics}: expected finite fx, fy, cx, cy with fx, fy above 0"
            )

    @classmethod
    def from_angle(cls, degrees: float, height: int, width: int) -> Lens:
        """A lens with a horizontal field of view, its axis through the middle of the image.

        Example:
            >>> Lens.from_angle(90.0, 100, 200).intrinsics
            (100.0, 100.0, 100.0, 50.0)
        """
        if not 0 < degrees < 180:
            raise InputError(f"angle={degrees}: expected degrees between 0 and 180")
        focal = round(width / 2 / math.tan(math.radians(degrees) / 2), 9)
        return cls((focal, focal, width / 2, height / 2), height, width)

    @classmethod
    def from_tensor(cls, intrinsics: Tensor, height: int, width: int) -> Lens:
        """A lens of intrinsics ``(4,)``, as a scene's views have them."""
        fx, fy, cx, cy = intrinsics.tolist()
        return cls((fx, fy, cx, cy), height, width)

    def resized(self, width: int) -> Lens:
        """The same view in a image of another width; the height follows."""
        factor = width / self.width
        fx, fy, cx, cy = self.intrinsics
        height = max(1, round(self.height * factor))
        vertical = height / self.height
        return Lens((fx * factor, fy * vertical, cx * factor, cy * vertical), height, width)


@dataclass(frozen=True)
class Camera:
    """A lens at a place.

    Args:
        pose: camera-to-world ``(4, 4)`` float32, looking along -z with y up in the image.
        lens: intrinsics and size.
    """

    pose: Tensor
    lens: Lens


def cameras_of(poses: Tensor, intrinsics: Tensor, height: int, width: int) -> tuple[Camera, ...]:
    """Return cameras of poses ``(V, 4, 4)`` and intrinsics ``(V, 4)``, with images of one size."""
    return tuple(
        Camera(pose, Lens.from_tensor(lens, height, width))
        for pose, lens in zip(poses, intrinsics, strict=True)
    )
