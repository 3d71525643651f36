"""Lens distortion: OpenCV's model, and images resampled as a pinhole camera would have taken them."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError

__all__ = ["NO_DISTORTION", "LensDistortion", "sample_bilinear", "undistort"]

Array = NDArray[np.float64]
_STRONGEST_ZOOM = 4.0


@dataclass(frozen=True)
class LensDistortion:
    """Coefficients of OpenCV's lens model; all zero is a pinhole.

    Attributes:
        k1, k2, k3: radial, numerator: ``1 + k1 r^2 + k2 r^4 + k3 r^6``.
        k4, k5, k6: radial, denominator, likewise.
        p1, p2: tangential.

    Source: OpenCV, "Camera Calibration and 3D Reconstruction".
    """

    k1: float = 0.0
    k2: float = 0.0
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0

    def __bool__(self) -> bool:
        return any(astuple(self))

    def distort(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Return where the lens puts what a pinhole would put at ``x``, ``y`` (in focal lengths)."""
        r2 = x * x + y * y
        above = 1 + r2 * (self.k1 + r2 * (self.k2 + r2 * self.k3))
        below = 1 + r2 * (self.k4 + r2 * (self.k5 + r2 * self.k6))
        radial = above / below
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
            y * radial + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
        )


NO_DISTORTION = LensDistortion()
"""A pinhole."""


def undistort(
    image: NDArray[np.float32], intrinsics: Array, distortion: LensDistortion, where: str
) -> tuple[NDArray[np.float32], Array]:
    """Resample an image (bilinearly) to a pinhole of the same size and principal point.

    The focal lengths grow or shrink by the least factor at which no pixel looks past the edge of the
    original.

    Args:
        image: ``(H, W, 4)`` straight-alpha RGBA.
        intrinsics: ``(4,)`` fx, fy, cx, cy in pixels of this image.
        distortion: of the lens that took it.
        where: file or frame, for messages.

    Returns:
        The image and its ``(4,)`` intrinsics.

    Raises:
        InputError: when the lens bends so strongly that no such pinhole exists.
    """
    height, width = image.shape[:2]
    zoom = _least_zoom(intrinsics, distortion, width, height, where)
    pinhole = intrinsics * [zoom, zoom, 1, 1]
    columns, rows = _source(_centres(width), _centres(height)[:, None], pinhole, intrinsics, distortion)
    # Weighted by alpha: the colour behind transparent pixels must not bleed into the others.
    premultiplied = np.concatenate([image[..., :3] * image[..., 3:], image[..., 3:]], axis=-1)
    sampled = sample_bilinear(premultiplied, columns, rows)
    colours = sampled[..., :3] / np.maximum(sampled[..., 3:], 1e-6)
    return np.concatenate([colours, sampled[..., 3:]], axis=-1), pinhole


def _centres(count: int) -> Array:
    return np.arange(count, dtype=np.float64) + 0.5


def _source(
    columns: Array, rows: Array, pinhole: Array, intrinsics: Array, distortion: LensDistortion
) -> tuple[Array, Array]:
    """Return the coordinates in the original of points of the pinhole image."""
    x, y = np.broadcast_arrays((columns - pinhole[2]) / pinhole[0], (rows - pinhole[3]) / pinhole[1])
    x, y = distortion.distort(x, y)
    return x * intrinsics[0] + intrinsics[2], y * intrinsics[1] + intrinsics[3]


def _least_zoom(intrinsics: Array, distortion: LensDistortion, width: int, height: int, where: str) -> float:
    across, along = _centres(width), _centres(height)
    columns = np.concatenate([across, across, np.full(height, 0.5), np.full(height, width - 0.5)])
    rows = np.concatenate([np.full(width, 0.5), np.full(width, height - 0.5), along, along])

    def inside(zoom: float) -> bool:
        # The whole way from the axis to the border counts: past its turning point a lens folds back.
        u, v = columns[:, None] - intrinsics[2], rows[:, None] - intrinsics[3]
        fraction = np.linspace(0, 1, 17)
        pinhole = intrinsics * [zoom, zoom, 1, 1]
        x, y = _source(
            intrinsics[2] + fraction * u, intrinsics[3] + fraction * v, pinhole, intrinsics, distortion
        )
        fits = (x >= 0.5 - 1e-6) & (x <= width - 0.5 + 1e-6) & (y >= 0.5 - 1e-6) & (y <= height - 0.5 + 1e-6)
        outward = np.diff((x - intrinsics[2]) * u + (y - intrinsics[3]) * v, axis=1) > 0
        return bool(fits.all() and outward.all())

    low, high = 1 / _STRONGEST_ZOOM, _STRONGEST_ZOOM
    if not inside(high):
        raise InputError(
            f"{where}: lens distortion {distortion} is too strong to be undone, expected a milder lens"
        )
    for _ in range(40):
        middle = (low + high) / 2
        low, high = (low, middle) if inside(middle) else (middle, high)
    return high


def sample_bilinear(image: NDArray[np.float32], columns: Array, rows: Array) -> NDArray[np.float32]:
    """Sample ``(H, W, C)`` at pixel coordinates whose pixel centres are at + 0.5, clamped to the border."""
    height, width = image.shape[:2]
    x = np.clip(columns - 0.5, 0, width - 1)
    y = np.clip(rows - 0.5, 0, height - 1)
    left = np.minimum(x.astype(np.int64), max(width - 2, 0))
    top = np.minimum(y.astype(np.int64), max(height - 2, 0))
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u = (x - left).astype(np.float32)[..., None]
    v = (y - top).astype(np.float32)[..., None]
    upper = image[top, left] * (1 - u) + image[top, right] * u
    lower = image[bottom, left] * (1 - u) + image[bottom, right] * u
    return np.asarray(upper * (1 - v) + lower * v)
