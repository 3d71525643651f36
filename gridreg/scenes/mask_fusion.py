"""Masks of an object on the sheet from first guesses, by the evidence of all photographs together.

Each pixel weighs its colour as the object's against what the others show of the table behind it. Matter is where no
photograph sees through, and its surface has one colour from all sides (the visual hull, and the photo hull of Kutulakos
and Seitz 2000): what the others know of a pixel's ray is weighed along. Terms are logarithms of ratios of likelihoods,
whose histograms come from the last guess, in turns.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage  # type: ignore[import-untyped]

from gridreg.scenes.board import Board
from gridreg.scenes.photo_hull import carve, neighbouring
from gridreg.scenes.sheet_views import COMPARED, SheetView, compared_with

__all__ = ["GAMMA", "fuse_masks", "normalised"]

Array = NDArray[np.float64]
Floats = NDArray[np.float32]
Mask = NDArray[np.bool_]

GAMMA = 2.2
"""Of the colours of photographs: light is their power of it."""
_BINS, _TOP = 24, 1.3
"""Of histograms of colours, and the colour at which they end; the white of paper is 1."""
_NOISE = 0.01
"""Least deviation of two photographs of one place."""
_CERTAIN = 4.0
"""Bound of what a pixel says by itself, and of what the colours that others see say."""
_CARVING = ((3.0, 1.0), (4.0, 0.5))
"""What a photograph says at most against, and for, matter in a cell: the first turn forgives more."""
_BEFORE = 0.05
"""Share of what is not the object that stands on the table, too."""
_HULL = 2.0
"""Most that the others say for matter on a pixel's ray."""
_UNDECIDED = 2.5
"""Evidence up to which edges decide where the object ends."""
_AROUND = np.ones((3, 3), dtype=bool)


def normalised(rgb: NDArray[np.uint8], white: Array) -> Floats:
    """Return colours ``(H, W, 3)`` with paper of the linear colour ``white`` at 1."""
    linear = (rgb / np.float32(255)) ** np.float32(GAMMA)
    return np.asarray((linear / white) ** (1 / GAMMA), dtype=np.float32)


def fuse_masks(
    views: Sequence[SheetView],
    small: Sequence[SheetView],
    whites: Sequence[Array],
    guesses: Sequence[Mask],
    board: Board,
) -> list[Mask]:
    """Return masks of the views.

    Args:
        views: the photographs.
        small: the same reduced, with `normalised` colours.
        whites: linear colour of their paper.
        guesses: masks of ``small`` to begin with.
        board: the sheet.
    """
    masks = list(guesses)
    for turn, (carving, margin, cell) in enumerate(zip(_CARVING, (0.5, 0.1), (2e-3, 1e-3), strict=True)):
        sources = views if turn else small
        parts, crops, within = [], [], []
        for source, white, mask in zip(sources, whites, masks, strict=True):
            grown = _resized(mask, source)
            part = _surroundings(grown, margin)
            crop = source.cropped(*part)
            crop.colours = normalised(crop.rgb, white)
            parts.append(part)
            crops.append(crop)
            within.append(grown[part])
        hidden = [
            ndimage.binary_dilation(_resized(m, s), _AROUND, 2) for m, s in zip(masks, small, strict=True)
        ]
        within = _turn(crops, within, small, hidden, board, cell, carving)
        masks = []
        for source, part, inner in zip(sources, parts, within, strict=True):
            masks.append(np.zeros(source.rgb.shape[:2], dtype=bool))
            masks[-1][part] = inner
    return masks


def _resized(mask: Mask, view: SheetView) -> Mask:
    height, width = view.rgb.shape[:2]
    return np.asarray(Image.fromarray(mask).resize((width, height), Image.Resampling.NEAREST))


def _surroundings(mask: Mask, margin: float) -> tuple[slice, slice]:
    """Return the rectangle of a mask, larger by a fraction of its longer edge; the whole image without one."""
    if not mask.any():
        return slice(0, mask.shape[0]), slice(0, mask.shape[1])
    sides = [np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0)]
    more = int(margin * max(int(np.ptp(side)) for side in sides)) + 8
    rows, columns = (slice(max(0, int(side[0]) - more), int(side[-1]) + 1 + more) for side in sides)
    return rows, columns


def _turn(
    crops: Sequence[SheetView],
    masks: Sequence[Mask],
    small: Sequence[SheetView],
    hidden: Sequence[Mask],
    board: Board,
    cell: float,
    carving: tuple[float, float],
) -> list[Mask]:
    """Return better masks of crops; ``hidden`` is where ``small`` does not show the table."""
    ranges = [np.ptp(neighbouring(view.colours), axis=0).max(axis=-1) for view in small]
    tables = [_table_behind(i, crop, small, hidden, ranges) for i, crop in enumerate(crops)]
    off = [
        np.abs(crop.colours - colour).max(axis=-1)[(near < 0.1) & ~ndimage.binary_dilation(mask, _AROUND, 5)]
        for crop, mask, (colour, _, near) in zip(crops, masks, tables, strict=True)
    ]
    noise = max(_NOISE, 1.2 * float(np.median(np.concatenate([*off, [0.0]]))))
    object_of = _histogram(np.concatenate([c.colours[m] for c, m in zip(crops, masks, strict=True)]))
    own = [
        _evidence(crop, mask, table, object_of, noise, board)
        for crop, mask, table in zip(crops, masks, tables, strict=True)
    ]
    hulls, agreeing = carve(crops, own, board, cell, carving)
    inside, outside = np.ones((2, COMPARED + 1))
    for mask, hull, agree in zip(masks, hulls, agreeing, strict=True):
        inside += np.bincount(agree[mask & (hull > 0)], minlength=COMPARED + 1)
        outside += np.bincount(agree[~mask & (hull > 0)], minlength=COMPARED + 1)
    surface = np.log(inside / inside.sum()) - np.log(outside / outside.sum())
    found = []
    for crop, mine, hull, agree in zip(crops, own, hulls, agreeing, strict=True):
        evidence = (
            mine + hull.clip(-4, _HULL) + np.where(hull > 0, surface[agree].clip(-_CERTAIN, _CERTAIN), 0)
        )
        found.append(_outline(_flood(evidence, crop.colours), crop.colours))
    return found


def _table_behind(
    i: int, crop: SheetView, small: Sequence[SheetView], hidden: Sequence[Mask], ranges: Sequence[Floats]
) -> tuple[Floats, Floats, Floats]:
    """Return what others see where a pixel's ray meets the table: the colour, its deviation, its range near by.

    ``(H, W, 3)`` and twice ``(H, W)``, infinite where nobody sees it.
    """
    places = crop.on_table()
    met = np.isfinite(places[..., 0])
    points = places[met]
    others = compared_with(i, len(small))
    colours = np.full((len(others), len(points), 3), np.inf, dtype=np.float32)
    wide = np.full((len(others), len(points)), np.inf, dtype=np.float32)
    for k, j in enumerate(others):
        positions, seen = small[j].positions(points)
        rows, columns = np.where(seen[:, None], positions, 0).astype(np.int64).T
        seen &= ~hidden[j][rows, columns]
        for channel in range(3):
            colours[k, seen, channel] = ndimage.map_coordinates(
                small[j].colours[..., channel], positions[seen].T - 0.5, order=1, mode="nearest"
            )
        wide[k, seen] = ranges[j][rows[seen], columns[seen]]
    count = np.isfinite(wide).sum(axis=0)
    colour = _median(colours, count)
    with np.errstate(invalid="ignore"):
        apart = np.abs(colours - colour).max(axis=-1)
    apart[~np.isfinite(apart)] = np.inf
    near = _median(wide, count)
    # What a single photograph shows may stand before the table.
    spread = np.sqrt(_median(apart, count) ** 2 + (0.1 * near) ** 2 + 0.06**2 * (count < 2))
    found = np.full((5, *met.shape), np.inf, dtype=np.float32)
    found[:3, met], found[3, met], found[4, met] = colour.T, spread, near
    return np.moveaxis(found[:3], 0, -1), found[3], found[4]


def _median(values: Floats, count: NDArray[np.int64]) -> Floats:
    """Return the lower median over the first axis of the ``count`` finite values."""
    at = np.maximum((count - 1) // 2, 0).reshape(1, -1, *[1] * (values.ndim - 2))
    return np.asarray(np.take_along_axis(np.sort(values, axis=0), at, axis=0)[0])


def _bins(colours: Floats) -> NDArray[np.int64]:
    bins = np.clip(colours * (_BINS / _TOP), 0, _BINS - 1).astype(np.int64)
    return np.asarray((bins[..., 0] * _BINS + bins[..., 1]) * _BINS + bins[..., 2])


def _histogram(colours: Floats) -> Array:
    """Return the density of colours ``(N, 3)``, by their `_bins`."""
    counts = np.bincount(_bins(colours).ravel(), minlength=_BINS**3).reshape((_BINS,) * 3)
    density = ndimage.gaussian_filter(counts.astype(np.float64), 0.8)
    density *= (_BINS / _TOP) ** 3 / max(density.sum(), 1e-9)
    return np.asarray(0.95 * density + 0.05 / _TOP**3).ravel()


def _evidence(
    crop: SheetView,
    mask: Mask,
    table: tuple[Floats, Floats, Floats],
    object_of: Array,
    noise: float,
    board: Board,
) -> Array:
    """Return by how much the colours of pixels speak for the object, ``(H, W)``: what lies behind speaks against it."""
    colours, (behind, spread, near) = crop.colours, table
    against = _histogram(colours[~mask])[_bins(colours)]
    # The free middle is white, and darker only where a shadow falls.
    x, y = np.moveaxis(np.abs(crop.on_table()[..., :2]), -1, 0)
    middle = (x < board.free[0] / 2) & (y < board.free[1] / 2)
    bright = colours.mean(axis=-1)
    tint = ((colours / np.maximum(bright, 0.05)[..., None] - 1) ** 2).sum(axis=-1) / 0.03**2
    shadow = np.exp(-tint / 2) / (2 * np.pi * 0.03**2) / 0.8 * ((bright > 0.3) & (bright < 1.1))
    against = np.where(middle, np.maximum(against, shadow), against)
    seen = np.isfinite(spread)
    deviation = np.sqrt(noise**2 + spread[seen] ** 2)
    apart = np.maximum(np.abs(colours[seen] - behind[seen]) - 0.15 * near[seen][:, None], 0)
    fitting = np.exp(-((apart / deviation[:, None]) ** 2).sum(axis=-1) / 2)
    against[seen] = _BEFORE * against[seen] + (1 - _BEFORE) * fitting / (deviation * np.sqrt(2 * np.pi)) ** 3
    said = (np.log(object_of[_bins(colours)]) - np.log(against)).clip(-_CERTAIN, _CERTAIN)
    return _guided(said, colours)


def _guided(values: Array, guide: Floats, reach: int = 3, least: float = 2e-3) -> Array:
    """Return values smoothed along the edges of a guide: the guided filter of He et al. (2010), eq. 19 to 21."""

    def mean(image: Array) -> Array:
        return np.asarray(ndimage.uniform_filter(image, 2 * reach + 1, mode="nearest"))

    channels = np.moveaxis(guide.astype(np.float64), -1, 0)
    means, middle = [mean(channel) for channel in channels], mean(values)
    matrix = np.empty((*values.shape, 3, 3))
    right = np.empty((*values.shape, 3))
    for a in range(3):
        right[..., a] = mean(channels[a] * values) - means[a] * middle
        for b in range(3):
            matrix[..., a, b] = mean(channels[a] * channels[b]) - means[a] * means[b] + (a == b) * least
    slope = np.moveaxis(np.linalg.solve(matrix, right[..., None])[..., 0], -1, 0)
    level = middle - sum(s * m for s, m in zip(slope, means, strict=True))
    return np.asarray(mean(level) + sum(mean(s) * c for s, c in zip(slope, channels, strict=True)))


def _flood(evidence: Array, colours: Floats) -> Mask:
    """Return where the object is: what is undecided belongs to the side that it has no edge to (a watershed)."""
    markers = (evidence > _UNDECIDED).astype(np.int16) + 2 * (evidence < -_UNDECIDED)
    if not {1, 2} <= {*np.unique(markers)}:
        return evidence > 0
    edges = sum(ndimage.gaussian_gradient_magnitude(channel, 0.7) for channel in np.moveaxis(colours, -1, 0))
    return np.asarray(ndimage.watershed_ift(np.clip(200 * edges, 0, 255).astype(np.uint8), markers) == 1)


def _outline(mask: Mask, colours: Floats, reach: int = 3) -> Mask:
    """Return the mask with pixels along its outline on the side whose colour has more of theirs."""
    core, out = ndimage.binary_erosion(mask, _AROUND), ~ndimage.binary_dilation(mask, _AROUND)

    def mean(where: Mask) -> tuple[Floats, Mask]:
        share = ndimage.uniform_filter(where.astype(np.float32), 2 * reach + 1)
        weighted = ndimage.uniform_filter(colours * where[..., None], (2 * reach + 1, 2 * reach + 1, 1))
        # Sums of the filter are not exact.
        return weighted / np.maximum(share, 1e-6)[..., None], share > 0.5 / (2 * reach + 1) ** 2

    (inner, has_inner), (outer, has_outer) = mean(core), mean(out)
    contrast = ((inner - outer) ** 2).sum(axis=-1)
    share = ((colours - outer) * (inner - outer)).sum(axis=-1) / np.maximum(contrast, 1e-4)
    return np.asarray(np.where(~core & ~out & has_inner & has_outer & (contrast > 0.01), share > 0.5, mask))
