"""Masks of an object on the sheet: what of a photograph is sheet or table, what rises above, and where views agree.

A photograph of a plane tells its colours wherever another one sees the same place of it. Light and object do not move
between photographs, so even shadows agree. What stands on the plane does not: pixels that two others contradict are
object, or clutter beside the sheet, which the visual hull of all views leaves out. That is a guess to begin with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]

from gridreg.scenes.board import Board, board_image
from gridreg.scenes.mask_fusion import GAMMA, fuse_masks, normalised
from gridreg.scenes.photo_hull import neighbouring
from gridreg.scenes.sheet_views import SheetView, compared_with

__all__ = ["cut_from_sheet"]

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_DOTS = 4
"""Pixels of the drawn sheet, a millimetre."""
_CLOSE = 0.06
"""Difference of two photographs of one place, of the white of paper, after gamma."""
_EDGE = 640
"""Longer edge of the images that are looked at first, and in which the others' table is looked up."""
_VOXELS = 128
_AROUND = np.ones((3, 3), dtype=bool)


@dataclass
class _Sorted:
    """Pixels ``(H, W)`` that are table or sheet for sure, may be paper that nobody else sees, and rise above."""

    table: Mask
    paper: Mask
    above: Mask


def cut_from_sheet(views: Sequence[SheetView], board: Board) -> list[Mask] | None:
    """Return masks ``(H, W)`` of what stands in the free middle of the sheet; None if nothing rises there.

    Args:
        views: at least three.
        board: the sheet.
    """
    page = np.asarray(board_image(board, _DOTS) / 255, dtype=np.float64)
    small = [view.reduced(_EDGE) for view in views]
    places = [view.on_table() for view in small]
    prints = [_print_at(place, board, page) for place in places]
    whites = []
    for view, printed in zip(small, prints, strict=True):
        white = ndimage.binary_erosion(printed > 0.98, np.ones((5, 5)))
        if not white.any():
            return None
        linear = (view.rgb[white] / 255) ** GAMMA
        whites.append(np.percentile(linear, 70, axis=0).clip(1e-3))
        view.colours = normalised(view.rgb, whites[-1])
    grid = _grid(board)
    ranges = [neighbouring(view.colours) for view in small]
    pixels = []
    for i, (view, printed) in enumerate(zip(small, prints, strict=True)):
        agreeing, seen = _agreement(i, small, places[i], ranges, _near_object(view, grid))
        pixels.append(_sort_pixels(view, printed, agreeing, seen))
    hull = _hull(small, pixels, grid)
    if not hull.any():
        return None
    # White that is seen low above the paper is paper; higher up it is the object's.
    tall = grid[hull][:, 2]
    guesses = []
    for view, kinds in zip(small, pixels, strict=True):
        high = _projected(view, grid[hull][tall > 0.4 * tall.max()])
        guesses.append(_projected(view, grid[hull]) & ~kinds.table & (high | ~kinds.paper))
    return fuse_masks(views, small, whites, guesses, board)


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
    ranges: Sequence[NDArray[np.float32]],
    near: Mask,
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """By pixel ``near`` the object: how many others see the same colour at its place of the table, how many see it."""
    met = np.isfinite(places[..., 0]) & near
    points, colours = places[met], views[i].colours[met]
    agreeing, seen = np.zeros((2, *met.shape), dtype=np.int64)
    for j in compared_with(i, len(views)):
        (rows, columns), inside = (found := views[j].pixels(points))[0].T, found[1]
        low, high = (bound[rows, columns] for bound in ranges[j])
        off = np.maximum(low - colours, colours - high).max(axis=-1)
        agreeing[met] += inside & (off < _CLOSE)
        seen[met] += inside
    return agreeing, seen


def _sort_pixels(
    view: SheetView, printed: Array, agreeing: NDArray[np.int64], seen: NDArray[np.int64]
) -> _Sorted:
    """Return what is table or sheet for sure, what may be paper that nobody else sees, and what rises above."""
    colours = view.colours
    brightest = colours.max(axis=-1)
    # Ink, paper and shadows on it are grey; the object's own ground, which others see in the same place, is not.
    grey = brightest - colours.min(axis=-1) < 0.1 * brightest + 0.04
    on_page = printed >= 0
    as_printed = (printed > 0.95) & (np.abs(colours - 1).max(axis=-1) < 2 * _CLOSE)
    table = (agreeing + as_printed >= 2) & (grey | ~on_page)
    table = ndimage.binary_opening(table, _AROUND)
    apart = table & ~on_page & (agreeing >= 3) & (agreeing >= 0.7 * seen)
    table = _larger(table, 3e-3) | _larger(ndimage.binary_opening(apart, _AROUND), 1e-4)
    white = grey & (printed > 0.95) & ~table & (brightest > 0.4) & (brightest < 1.15)
    labels, _ = ndimage.label(white)
    beside = np.unique(labels[ndimage.binary_dilation(table, _AROUND) & white])
    paper = np.isin(labels, beside[beside > 0])
    return _Sorted(table, paper, (seen >= 2) & ~table & ~paper)


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


def _hull(views: Sequence[SheetView], sorted_pixels: Sequence[_Sorted], grid: Array) -> Mask:
    """The largest part of what is table in no view, and above it in half of those that see it."""
    points = grid.reshape(-1, 3)
    kept = np.ones(len(points), dtype=bool)
    above, seen = np.zeros((2, len(points)), dtype=np.int64)
    for view, kinds in zip(views, sorted_pixels, strict=True):
        (rows, columns), inside = (found := view.pixels(points))[0].T, found[1]
        kept &= ~(inside & kinds.table[rows, columns])
        above += inside & kinds.above[rows, columns]
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
