"""Cells above the sheet that photographs leave standing: none sees through, and from all sides one colour is seen.

A soft visual hull: what photographs say for or against matter is summed over them, within bounds, so that one that errs
carves nothing away that all others see. Each photograph is told what the others say, as it weighs its own view itself.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage  # type: ignore[import-untyped]

from gridreg.scenes.board import Board
from gridreg.scenes.sheet_views import SheetView, compared_with

__all__ = ["carve", "neighbouring"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]

_SAME = 0.06
"""Difference up to which two photographs show one surface, of the white of paper."""
_COARSE = 4
"""Cells along an edge of those that are looked at first."""


def neighbouring(colours: Floats) -> Floats:
    """Return the least and largest colours ``(2, H, W, 3)`` of the 3 by 3 pixels around each."""
    filters = ndimage.minimum_filter, ndimage.maximum_filter
    return np.stack([each(colours, size=(3, 3, 1)) for each in filters])


def carve(
    views: Sequence[SheetView],
    evidence: Sequence[Array],
    board: Board,
    cell: float,
    bounds: tuple[float, float],
) -> tuple[list[Floats], list[NDArray[np.int64]]]:
    """Return what other photographs know of the ray of each pixel, as high over the sheet as its free middle is long.

    Args:
        views: with colours.
        evidence: ``(H, W)`` of each, by how much its pixels speak for the object.
        board: the sheet.
        cell: edge of a cell, metres.
        bounds: of the evidence against, and for, that one photograph gives.

    Returns:
        For each view ``(H, W)``: the largest sum of evidence that others have for matter in a cell on the ray, and the
        number of others, of those it is compared with, in which the cell of the ray where most of them do has the
        pixel's colour.
    """
    size = max(board.free)
    axes = [np.arange(_COARSE * cell / 2, length, _COARSE * cell) for length in (*board.free, size)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    points[:, :2] -= np.array(board.free) / 2
    said, _ = _said(views, evidence, points, _COARSE * cell, bounds)
    inner = (np.indices((_COARSE,) * 3).reshape(3, -1).T - (_COARSE - 1) / 2) * cell
    points = (points[said.sum(axis=0) - said.min(axis=0) > 0, None] + inner).reshape(-1, 3)
    said, places = _said(views, evidence, points, cell, bounds)
    total = said.sum(axis=0)
    kept = total - said.min(axis=0) > -4
    said, total = said[:, kept], total[kept]
    places = [(pixels[kept], seen[kept], reach) for pixels, seen, reach in places]
    # Bytes: of 40 photographs and a million cells.
    around = [
        np.rint(neighbouring(view.colours)[:, pixels[:, 0], pixels[:, 1]].clip(0, 1.25) * 200).astype(
            np.uint8
        )
        for view, (pixels, _, _) in zip(views, places, strict=True)
    ]
    same = round(200 * _SAME)
    hulls, agreeing = [], []
    for i, (view, (pixels, seen, reach)) in enumerate(zip(views, places, strict=True)):
        others = total - said[i]
        hull = np.full(view.rgb.shape[:2], -99.0, dtype=np.float32)
        np.maximum.at(hull, tuple(pixels[seen].T), others[seen])
        hulls.append(ndimage.maximum_filter(hull, 2 * reach + 1))
        near = seen & (others > 0)
        own = np.rint(view.colours[tuple(pixels[near].T)].clip(0, 1.25) * 200).astype(np.int16)
        count = np.zeros(len(own), dtype=np.int64)
        for j in compared_with(i, len(views)):
            low, high = around[j][:, near].astype(np.int16)
            count += ((own >= low - same) & (own <= high + same)).all(axis=-1) & places[j][1][near]
        most = np.zeros(view.rgb.shape[:2], dtype=np.int64)
        np.maximum.at(most, tuple(pixels[near].T), count)
        agreeing.append(ndimage.maximum_filter(most, 2 * reach + 1))
    return hulls, agreeing


def _said(
    views: Sequence[SheetView],
    evidence: Sequence[Array],
    points: Array,
    cell: float,
    bounds: tuple[float, float],
) -> tuple[Floats, list[tuple[NDArray[np.int64], NDArray[np.bool_], int]]]:
    """Return the bounded evidence ``(V, N)`` at cells, and of each view their pixels, if they are seen, and reach."""
    said = np.empty((len(views), len(points)), dtype=np.float32)
    places = []
    for row, view, mine in zip(said, views, evidence, strict=True):
        pixels, seen = view.pixels(points)
        distance = float(np.linalg.norm(view.pose[:3, 3] - points.mean(axis=0)))
        reach = int(np.ceil(cell * view.intrinsics[0] / distance / 2))
        best = ndimage.maximum_filter(mine, 2 * reach + 1).clip(-bounds[0], bounds[1])
        # What a photograph does not reach may be matter.
        row[:] = np.where(seen, best[tuple(pixels.T)], -bounds[0] if view.inner else 0)
        places.append((pixels, seen, reach))
    return said, places
