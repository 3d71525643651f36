"""Masks of an object on the sheet: what of a photograph is sheet or table, what rises above, and where views agree.

A photograph of a plane tells its colours wherever another one sees the same place of it. Light and object do not move
between photographs, so even shadows agree. What stands on the plane does not: pixels that two others contradict are
object, or clutter beside the sheet, which the visual hull of all views leaves out. GrabCut settles the outline.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]

from gridreg.scenes.board import Board, board_image
from gridreg.scenes.lens import LensDistortion

__all__ = ["SheetView", "cut_from_sheet"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_GAMMA = 2.2
_DOTS = 4
"""Pixels of the drawn sheet, a millimetre."""
_CLOSE = 0.06
"""Difference of two photographs of one place, of the white of paper, after gamma."""
_REACH = 1.2
"""Metres from the sheet's middle up to which the table is looked at."""
_VOXELS = 128
_OTHERS = 12
"""Photographs at most that each is compared with."""
_AROUND = np.ones((3, 3), dtype=bool)


@dataclass
class SheetView:
    """A photograph with its camera in the sheet's metres, z up.

    Attributes:
        rgb: ``(H, W, 3)`` uint8.
        pose: ``(4, 4)`` camera-to-world, looking along -z, y up in the image.
        intrinsics: fx, fy, cx, cy in pixels of this image.
        lens: its distortion.
    """

    rgb: NDArray[np.uint8]
    pose: Array
    intrinsics: tuple[float, float, float, float]
    lens: LensDistortion
    colours: NDArray[np.float32] = field(init=False)
    table: Mask = field(init=False)
    paper: Mask = field(init=False)
    above: Mask = field(init=False)

    def pixels(self, points: Array) -> tuple[NDArray[np.int64], Mask]:
        """Row and column ``(N, 2)`` of points ``(N, 3)``, and whether they are in the image."""
        height, width = self.rgb.shape[:2]
        fx, fy, cx, cy = self.intrinsics
        local = (points - self.pose[:3, 3]) @ self.pose[:3, :3]
        depth = -local[:, 2]
        before = depth > 1e-6
        x, y = local[:, 0] / np.where(before, depth, 1), -local[:, 1] / np.where(before, depth, 1)
        # Far outside a lens folds back.
        before &= np.hypot(x * fx, y * fy) < 1.2 * np.hypot(width, height)
        x, y = self.lens.distort(np.where(before, x, 0), np.where(before, y, 0))
        found = np.floor(np.stack([y * fy + cy, x * fx + cx], axis=-1)).astype(np.int64)
        inside = before & (found >= 1).all(axis=1) & (found < (height - 1, width - 1)).all(axis=1)
        found[~inside] = 0
        return found, inside

    def on_table(self) -> Array:
        """Points ``(H, W, 3)`` in which the rays of all pixels meet the table, NaN far away and above."""
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


def cut_from_sheet(views: Sequence[SheetView], board: Board) -> list[Mask] | None:
    """Masks ``(H, W)`` of what stands in the free middle of the sheet; None if nothing rises there.

    Args:
        views: at least three, about 800 pixels wide.
        board: the sheet.
    """
    page = np.asarray(board_image(board, _DOTS) / 255, dtype=np.float64)
    places = [view.on_table() for view in views]
    prints = [_print_at(place, board, page) for place in places]
    for view, printed in zip(views, prints, strict=True):
        white = ndimage.binary_erosion(printed > 0.98, np.ones((5, 5)))
        if not white.any():
            return None
        linear = (view.rgb / np.float32(255)) ** np.float32(_GAMMA)
        paper = np.percentile(linear[white], 70, axis=0).clip(1e-3)
        view.colours = np.asarray((linear / paper) ** (1 / _GAMMA), dtype=np.float32)
    grid = _grid(board)
    ranges = [
        [f(view.colours, size=(3, 3, 1)) for f in (ndimage.minimum_filter, ndimage.maximum_filter)]
        for view in views
    ]
    for i, (view, printed) in enumerate(zip(views, prints, strict=True)):
        agreeing, seen = _agreement(i, views, places[i], ranges, _near_object(view, grid))
        _sort_pixels(view, printed, agreeing, seen)
    hull = _hull(views, grid)
    if not hull.any():
        return None
    # White that is seen low above the paper is paper; higher up it is the object's.
    tall = grid[hull][:, 2]
    for view in views:
        high = _projected(view, grid[hull][tall > 0.4 * tall.max()])
        view.paper &= ~high
        view.above |= high & ~view.table & ~view.paper
    return [_grab(view, _projected(view, grid[hull])) for view in views]


def _print_at(places: Array, board: Board, page: Array) -> Array:
    """The print at places of the table: 1 is white, 0 black, -1 beside the page."""
    x = (places[..., 0] + board.middle[0]) * 1000 * _DOTS
    y = page.shape[0] - (places[..., 1] + board.middle[1]) * 1000 * _DOTS
    inside = (x >= 0) & (x < page.shape[1]) & (y >= 0) & (y < page.shape[0])
    found = np.full(x.shape, -1.0)
    found[inside] = page[y[inside].astype(int), x[inside].astype(int)]
    return found


def _agreement(
    i: int,
    views: Sequence[SheetView],
    places: Array,
    ranges: Sequence[Sequence[NDArray[np.float32]]],
    near: Mask,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """By pixel ``near`` the object: how many others see the same colour at its place of the table, how many see it."""
    met = np.isfinite(places[..., 0]) & near
    points, colours = places[met], views[i].colours[met]
    agreeing, seen = np.zeros((2, *met.shape), dtype=np.int64)
    others = [j for j in range(len(views)) if j != i]
    for j in others[:: -(-len(others) // _OTHERS)]:
        (rows, columns), inside = (found := views[j].pixels(points))[0].T, found[1]
        low, high = (bound[rows, columns] for bound in ranges[j])
        off = np.maximum(low - colours, colours - high).max(axis=-1)
        agreeing[met] += inside & (off < _CLOSE)
        seen[met] += inside
    return agreeing, seen


def _sort_pixels(
    view: SheetView, printed: Array, agreeing: NDArray[np.int64], seen: NDArray[np.int64]
) -> None:
    """Set what is table or sheet for sure, what may be paper that nobody else sees, and what rises above."""
    colours = view.colours
    brightest = colours.max(axis=-1)
    # Ink, paper and shadows on it are grey; the object's own ground, which others see in the same place, is not.
    grey = brightest - colours.min(axis=-1) < 0.1 * brightest + 0.04
    on_page = printed >= 0
    as_printed = (printed > 0.95) & (np.abs(colours - 1).max(axis=-1) < 2 * _CLOSE)
    table = (agreeing + as_printed >= 2) & (grey | ~on_page)
    table = ndimage.binary_opening(table, _AROUND)
    apart = table & ~on_page & (agreeing >= 3) & (agreeing >= 0.7 * seen)
    view.table = _larger(table, 3e-3) | _larger(ndimage.binary_opening(apart, _AROUND), 1e-4)
    white = grey & (printed > 0.95) & ~view.table & (brightest > 0.4) & (brightest < 1.15)
    labels, _ = ndimage.label(white)
    beside = np.unique(labels[ndimage.binary_dilation(view.table, _AROUND) & white])
    view.paper = np.isin(labels, beside[beside > 0])
    view.above = (seen >= 2) & ~view.table & ~view.paper


def _near_object(view: SheetView, grid: Array) -> Mask:
    """The rectangle of an image that voxels project to, and a margin."""
    found, inside = view.pixels(grid[:: _VOXELS // 8, :: _VOXELS // 8, :: _VOXELS // 8].reshape(-1, 3))
    near = np.zeros(view.rgb.shape[:2], dtype=bool)
    if inside.any():
        low, high = found[inside].min(axis=0), found[inside].max(axis=0)
        margin = (high - low) // 6
        top, left = np.maximum(low - margin, 0)
        near[top : high[0] + margin[0], left : high[1] + margin[1]] = True
    return near


def _larger(mask: Mask, fraction: float) -> Mask:
    """The connected parts with more than a fraction of all pixels."""
    labels, _ = ndimage.label(mask)
    kept = np.bincount(labels.ravel()) > fraction * mask.size
    kept[0] = False
    return np.asarray(kept[labels])


def _grid(board: Board) -> Array:
    """Voxels ``(X, Y, Z, 3)`` over the free middle, as high as it is long."""
    size = max(board.free)
    edge = size / _VOXELS
    axes = [np.arange(edge / 2, length, edge) for length in (*board.free, size)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    grid[..., :2] -= np.array(board.free) / 2
    return grid


def _hull(views: Sequence[SheetView], grid: Array) -> Mask:
    """The largest part of what is table in no view, and above it in half of those that see it."""
    points = grid.reshape(-1, 3)
    kept = np.ones(len(points), dtype=bool)
    above, seen = np.zeros((2, len(points)), dtype=np.int64)
    for view in views:
        (rows, columns), inside = (found := view.pixels(points))[0].T, found[1]
        kept &= ~(inside & view.table[rows, columns])
        above += inside & view.above[rows, columns]
        seen += inside
    kept &= (above >= 2) & (above >= 0.5 * seen)
    labels, _ = ndimage.label(kept.reshape(grid.shape[:3]), np.ones((3, 3, 3)))
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    # A speck is no object.
    return np.asarray((labels == sizes.argmax()) & (sizes.max() > 1e-4 * kept.size))


def _projected(view: SheetView, points: Array) -> Mask:
    """Pixels ``(H, W)`` that voxels project to, without gaps between them."""
    found = np.zeros(view.rgb.shape[:2], dtype=bool)
    if not len(points):
        return found
    (rows, columns), inside = (seen := view.pixels(points))[0].T, seen[1]
    found[rows[inside], columns[inside]] = True
    edge = float(np.ptp(np.unique(points[:, 2])[:2])) or 1e-3
    distance = float(np.linalg.norm(points - view.pose[:3, 3], axis=1).mean())
    reach = int(np.ceil(edge * view.intrinsics[0] / distance / 2)) + 1
    return np.asarray(ndimage.binary_closing(found, np.ones((2 * reach + 1,) * 2)))


def _grab(view: SheetView, hull: Mask) -> Mask:
    """The object within the projection of the hull, by GrabCut (Rother et al. 2004)."""
    import cv2

    near = ndimage.binary_dilation(hull, _AROUND, iterations=2)
    labels = np.full(hull.shape, cv2.GC_BGD, dtype=np.uint8)
    labels[near & ~view.table] = cv2.GC_PR_BGD
    labels[hull & ~view.table & ~view.paper] = cv2.GC_PR_FGD
    labels[ndimage.binary_erosion(view.above & hull, _AROUND, iterations=2)] = cv2.GC_FGD
    if not (labels == cv2.GC_FGD).any() and not (labels == cv2.GC_PR_FGD).any():
        return np.zeros_like(hull)
    rows, columns = (np.flatnonzero(near.any(axis=axis)) for axis in (1, 0))
    part = tuple(slice(max(0, int(at[0]) - 30), int(at[-1]) + 31) for at in (rows, columns))
    cut = np.ascontiguousarray(labels[part])
    models = np.zeros((1, 65)), np.zeros((1, 65))
    # The models of colours are drawn at random.
    cv2.setRNGSeed(0)
    cv2.grabCut(np.ascontiguousarray(view.rgb[part][..., ::-1]), cut, None, *models, 3, cv2.GC_INIT_WITH_MASK)  # type: ignore[call-overload]
    labels[part] = cut
    return np.asarray((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))
