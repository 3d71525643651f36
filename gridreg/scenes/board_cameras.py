"""Cameras of photographs of the sheet: lens and poses from its markers, no overlap between photographs needed.

Each photograph is placed by itself (perspective-n-point on a plane); then lenses and poses are adjusted together, over
all corners, robustly. Lengths are metres, z is up, the sheet's middle is the origin.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from gridreg.scenes.board import BOARDS, Board
from gridreg.scenes.bundle_adjustment import TURNED, BundleAdjustment, Photograph
from gridreg.scenes.decoding import open_image
from gridreg.scenes.extent import Extent
from gridreg.scenes.frames import Frame
from gridreg.scenes.markers import find_markers

__all__ = ["OnBoard", "board_extent", "look_for_board", "place_on_board"]

Array = NDArray[np.float64]

_FEWEST_MARKERS = 3
_FEWEST_PHOTOGRAPHS = 3
# Pixels that the median of a photograph's corners may be off that belongs to the others.
_ASTRAY = 3.0


class OnBoard(NamedTuple):
    """Cameras found on the sheet.

    Attributes:
        board: the sheet.
        frames: frames of the photographs that could be placed.
        left_out: why the others were not, by name.
        off: median distance of corners from where the cameras put them, pixels.
    """

    board: Board
    frames: list[Frame]
    left_out: dict[str, str]
    off: float


def look_for_board(
    images: Sequence[tuple[Path, tuple[int, int], Image.Transpose | None]],
) -> tuple[Board, list[Photograph]] | None:
    """Return the sheet that upright images show, and what is known of them; None where too few show one.

    Args:
        images: file, size and turn of each.
    """
    photographs = []
    for path, size, turn in images:
        lens, focal = _lens_of(path, size, turn)
        photographs.append(Photograph(path.name, size, turn, lens, focal, find_markers(path)))
    seen = Counter(
        board.paper
        for board in BOARDS.values()
        for photograph in photographs
        if len(photograph.markers.keys() & board.corners.keys()) >= _FEWEST_MARKERS
    )
    if not seen or seen.most_common(1)[0][1] < _FEWEST_PHOTOGRAPHS:
        return None
    board = BOARDS[seen.most_common(1)[0][0]]
    for photograph in photographs:
        photograph.markers = {n: c for n, c in photograph.markers.items() if n in board.corners}
    return board, photographs


def _lens_of(
    path: Path, size: tuple[int, int], turn: Image.Transpose | None
) -> tuple[tuple[Any, ...], float | None]:
    """Return what tells lenses apart, and the focal length in pixels, from EXIF data."""
    with open_image(path) as image:
        exif = image.getexif()
    noted = exif.get_ifd(ExifTags.IFD.Exif)
    sideways = TURNED[turn][0][0] == 0
    names = [str(exif.get(tag, "")) for tag in (ExifTags.Base.Make, ExifTags.Base.Model)]
    lengths = [noted.get(tag) for tag in (ExifTags.Base.FocalLength, ExifTags.Base.FocalLengthIn35mmFilm)]
    try:
        focal = float(lengths[1] or 0) * math.hypot(*size) / math.hypot(36, 24)
    except (TypeError, ValueError):
        focal = 0.0
    known = focal if 0.2 < focal / max(size) < 20 else None
    return (*names, *map(str, lengths), size[::-1] if sideways else size), known


def place_on_board(
    board: Board, photographs: Sequence[Photograph], progress: Callable[[str], None]
) -> OnBoard:
    """Find lenses and poses from the corners of markers.

    Args:
        board: the sheet.
        photographs: with their markers; those with fewer than three, or that do not fit, are left out and named.
        progress: called with what there is to say.
    """
    left_out = {
        p.name: f"{len(p.markers)} markers seen, expected {_FEWEST_MARKERS}"
        for p in photographs
        if len(p.markers) < _FEWEST_MARKERS
    }
    placed = [p for p in photographs if p.name not in left_out]
    first = BundleAdjustment(board, placed)
    first.start()
    first.solve()
    off = first.median_off()
    astray = {p.name for p, value in zip(placed, off, strict=True) if value > _ASTRAY + 3 * np.median(off)}
    left_out |= dict.fromkeys(astray, "its markers lie elsewhere than in the others (was the sheet moved?)")
    if astray:
        placed = [p for p in placed if p.name not in astray]
        first = BundleAdjustment(board, placed)
        first.start()
        first.solve()
    typical = float(np.median(first.median_off()))
    progress(
        f"{len(placed)} of {len(photographs)} photographs placed by markers, corners off by {typical:.2f} pixels"
    )
    return OnBoard(board, first.frames(), left_out, typical)


def board_extent(board: Board, frames: Sequence[Frame]) -> Extent:
    """Return a box above the sheet, as wide as its ring of markers, and near and far for the cameras.

    It is as high as most photographs show the axis through the sheet's middle, at most twice the sheet's width: who
    photographs an object has it whole in the image.
    """
    heights = np.linspace(0, 2 * board.width, 200)
    axis = np.stack([0 * heights, 0 * heights, heights], axis=-1)
    tops = []
    for frame in frames:
        assert frame.camera.size is not None
        width, height = (int(edge) for edge in frame.camera.size)
        fx, fy, cx, cy = frame.camera.intrinsics(width, height)
        x, y, z = ((axis - frame.pose[:3, 3]) @ frame.pose[:3, :3]).T
        depth = np.where(z < -1e-6, -z, np.inf)
        column, row = fx * x / depth + cx, cy - fy * y / depth
        inside = (z < -1e-6) & (row >= 0) & (row < height)
        inside &= (column >= 0) & (column < width)
        tops.append(heights[np.argmin(inside) - 1] if not inside.all() else heights[-1])
    top = max(float(np.quantile(tops, 0.25)), 0.25 * board.width)
    half = np.array(board.ring) / 2
    bounds = np.array([[-half[0], -half[1], 0.0], [half[0], half[1], top]])
    ends = np.stack(np.meshgrid(*bounds.T), axis=-1).reshape(-1, 3)
    origins = np.array([frame.pose[:3, 3] for frame in frames])
    outside = np.linalg.norm(origins - np.clip(origins, *bounds), axis=1)
    far = float(np.linalg.norm(origins[:, None] - ends, axis=-1).max())
    return Extent(max(0.9 * float(outside.min()), 0.02 * far), 1.05 * far, bounds)
