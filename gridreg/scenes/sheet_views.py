"""Photographs of the sheet with their cameras: where places of space and of the table are in them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.scenes.lens import LensDistortion

__all__ = ["COMPARED", "SheetView", "compared_with"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_REACH = 1.2
"""Metres from the sheet's middle up to which the table is looked at."""

COMPARED = 12
"""Photographs at most that each is compared with."""


def compared_with(i: int, count: int) -> list[int]:
    """Return the photographs that the i-th of ``count`` is compared with: all others, or evenly some of them.

    >>> compared_with(1, 4), len(compared_with(0, 40))
    ([0, 2, 3], 10)
    """
    others = [j for j in range(count) if j != i]
    return others[:: -(-len(others) // COMPARED)]


@dataclass
class SheetView:
    """A photograph with its camera in the sheet's metres, z up.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        pose: ``(4, 4)`` camera-to-world, looking along -z, y up in the image.
        intrinsics: fx, fy, cx, cy in pixels of this image.
        lens: its distortion.
        inner: whether it is part of a photograph, and reaches to none of its edges.
        colours: ``(H, W, 3)`` float32, the white of the sheet's paper is 1.
    """

    rgb: NDArray[np.uint8]
    pose: Array
    intrinsics: tuple[float, float, float, float]
    lens: LensDistortion
    inner: bool = field(default=False, init=False)
    colours: NDArray[np.float32] = field(init=False)

    def reduced(self, edge: int) -> SheetView:
        """Return the same at most ``edge`` pixels long."""
        height, width = self.rgb.shape[:2]
        size = [max(1, round(min(1, edge / max(width, height)) * length)) for length in (width, height)]
        rgb = np.asarray(Image.fromarray(self.rgb).resize((size[0], size[1]), Image.Resampling.BOX))
        (x, y), (fx, fy, cx, cy) = (size[0] / width, size[1] / height), self.intrinsics
        return SheetView(rgb, self.pose, (fx * x, fy * y, cx * x, cy * y), self.lens)

    def cropped(self, rows: slice, columns: slice) -> SheetView:
        """Return a part of it, with the camera of the part."""
        fx, fy, cx, cy = self.intrinsics
        inner = fx, fy, cx - columns.start, cy - rows.start
        part = SheetView(np.ascontiguousarray(self.rgb[rows, columns]), self.pose, inner, self.lens)
        height, width = self.rgb.shape[:2]
        part.inner = min(rows.start, columns.start) > 0 and rows.stop < height and columns.stop < width
        return part

    def positions(self, points: Array) -> tuple[Array, Mask]:
        """Return row and column ``(N, 2)`` of points ``(N, 3)``, pixels from the corner, and whether they are seen."""
        height, width = self.rgb.shape[:2]
        fx, fy, cx, cy = self.intrinsics
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        depth = -local[:, 2]
        before = depth > 1e-6
        x, y = local[:, 0] / np.where(before, depth, 1), -local[:, 1] / np.where(before, depth, 1)
        # Far outside a lens folds back.
        corner = np.hypot(max(cx, width - cx), max(cy, height - cy))
        before &= np.hypot(x * fx, y * fy) < 2 * corner
        x, y = self.lens.distort(np.where(before, x, 0), np.where(before, y, 0))
        found = np.stack([y * fy + cy, x * fx + cx], axis=-1)
        return found, before & (found >= 1).all(axis=1) & (found < (height - 1, width - 1)).all(axis=1)

    def pixels(self, points: Array) -> tuple[NDArray[np.int64], Mask]:
        """Return the pixels ``(N, 2)`` of points, row and column, and whether they are in the image."""
        found, inside = self.positions(points)
        return np.where(inside[:, None], found, 0).astype(np.int64), inside

    def on_table(self) -> Array:
        """Return points ``(H, W, 3)`` in which the rays of all pixels meet the table, NaN far away and above."""
        height, width = self.rgb.shape[:2]
        fx, fy, cx, cy = self.intrinsics
        bent = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
        x, y = bent
        for _ in range(20):
            again = self.lens.distort(x, y)
            x, y = x + bent[0] - again[0], y + bent[1] - again[1]
        rays = np.stack([x, -y, -np.ones_like(x)], axis=-1) @ self.pose[:3, :3].T
        length = -self.pose[2, 3] / np.where(rays[..., 2] < -1e-3, rays[..., 2], np.nan)
        points: Array = self.pose[:3, 3] + length[..., None] * rays
        points[np.linalg.norm(points[..., :2], axis=-1) > _REACH] = np.nan
        points[..., 2] *= 0
        return points
