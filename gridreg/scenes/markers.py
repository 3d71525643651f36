"""Fiducial markers of the sheet in a photograph: which are there, and where their corners are."""

from __future__ import annotations

import importlib.util
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.scenes.decoding import open_image
from gridreg.scenes.lens import sample_bilinear

__all__ = ["OPENCV", "find_markers", "has_opencv"]

Array = NDArray[np.float64]

OPENCV = "OpenCV (pip install 'gridreg[photos]')"
"""Optional package that sees the markers, and how to get it."""

# Longer edge in pixels at which markers are looked for: they stay large, and noise is averaged.
_EDGE = 2000
# Of a display's curve: corners are refined where light adds up.
_GAMMA = 2.2
_MODULES = 6


def has_opencv() -> bool:
    """Tell whether markers can be looked for."""
    return importlib.util.find_spec("cv2") is not None


def find_markers(path: Path) -> dict[int, Array]:
    """Return the ``(4, 2)`` corners of the markers in an upright image by their number, pixels of the image.

    Corners come in the order of `gridreg.scenes.board.Board.corners`; a pixel's centre is at + 0.5.

    Raises:
        InputError: when the image cannot be read.
    """
    import cv2

    with open_image(path) as image:
        width = image.width
        fraction = min(1.0, _EDGE / max(image.size))
        size = round(image.width * fraction), round(image.height * fraction)
        grey = image.convert("L")
        if fraction < 1:
            grey = grey.resize(size, Image.Resampling.BOX)
    levels = np.asarray(grey)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_100)
    settings: Any = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(levels)
    # In the display's curve the bright side of an edge takes more than its half: corners would move inwards.
    light = (255 * (np.arange(256) / 255) ** _GAMMA).astype(np.float32)[levels]
    found: dict[int, Array] = {}
    twice: set[int] = set()
    for marker, number in zip(corners, [] if numbers is None else numbers.ravel().tolist(), strict=True):
        refined = _by_edges(light, marker[0].astype(np.float64))
        twice |= {number} & found.keys()
        found[number] = (refined + 0.5) * (width / size[0])
    # One of two markers of one number is somebody else's, and nothing says which.
    return {number: place for number, place in found.items() if number not in twice}


def _by_edges(light: NDArray[np.float32], corners: Array) -> Array:
    """Return the ``(4, 2)`` corners where lines through the four edges of a dark square meet.

    An edge's place on a line across it is where as much light is missing before as there is too much behind.
    """
    lines = []
    for k in range(4):
        start, along = corners[k], corners[(k + 1) % 4] - corners[k]
        length = float(np.linalg.norm(along))
        inwards = np.array([-along[1], along[0]]) / length
        depth = float(((corners[(k + 2) % 4] + corners[(k + 3) % 4]) / 2 - start) @ inwards)
        # The black rim is a sixth of the marker wide; more than half of it would meet what is inside.
        reach = float(np.clip(0.5 * depth / _MODULES, 1.5, 5.0))
        across = np.linspace(-reach, reach, 25)
        places = np.linspace(0.1, 0.9, max(6, int(length)))
        at = start + places[:, None, None] * along + across[:, None] * inwards
        profile = sample_bilinear(light[..., None], at[..., 0] + 0.5, at[..., 1] + 0.5)[..., 0]
        bright, dark = np.median(profile[:, :3], axis=1), np.median(profile[:, -3:], axis=1)
        clear = bright - dark > 0.5 * np.median(bright - dark)
        if clear.sum() < 4 or np.median(bright - dark) <= 0:
            return corners
        part = ((profile - dark[:, None]) / np.where(clear, bright - dark, 1)[:, None])[clear]
        edge = np.clip(part, -0.5, 1.5).mean(axis=1) * 2 * reach - reach
        slope, offset = _line(places[clear] * length, edge)
        lines.append((start + offset * inwards, along / length + slope * inwards))
    met = []
    for (p, u), (q, v) in zip(lines, np.roll(np.array(lines), 1, axis=0), strict=True):
        # From the edge that ends in a corner to the one that begins there.
        matrix = np.stack([u, -v], axis=1)
        if abs(np.linalg.det(matrix)) < 1e-3:
            return corners
        met.append(p + np.linalg.solve(matrix, q - p)[0] * u)
    found = np.array(met)
    return found if np.abs(found - corners).max() < 3 else corners


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Return slope and offset of the line through points, without those further off than twice the usual."""
    kept = np.ones(len(x), dtype=bool)
    slope, offset = 0.0, 0.0
    for _ in range(3):
        slope, offset = np.polyfit(x[kept], y[kept], 1)
        off = np.abs(y - slope * x - offset)
        kept = off <= 3 * np.median(off) + 1e-6
        if kept.sum() < 4:
            break
    return float(slope), float(offset)
