"""Masks as other tools write them: what is kept, and what is refused because it could mean several things."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes.images import SIDEWAYS, decode

__all__ = ["fit_mask", "read_mask"]

# Brightness above which a grey mask is white somewhere, and what JPEG leaves of black and white.
_WHITE, _NOISE = 0.97, 0.03
# Fraction of an image that flat areas of in-between values may cover: soft edges have none, labels are made
# of them.
_MOST_FLAT = 0.02


def read_mask(path: Path, *, as_stored: bool = False) -> NDArray[np.float32]:
    """Read a mask: white (or opaque, where alpha varies) is kept, black is background.

    A mask of two values, one of them black, keeps the other, whatever it is (0 and 1, a palette, a colour).
    Grey edges are kept as they are.

    Args:
        path: the file.
        as_stored: see :func:`gridreg.scenes.images.decode`.

    Returns:
        ``(H, W)`` float32 in [0, 1].

    Raises:
        InputError: when the file is missing or cannot be decoded, or holds labels or colours that could mean
            anything.
    """
    return _meaning(decode(path, as_stored=as_stored).pixels, path)


def fit_mask(
    path: Path, size: tuple[int, int], turn: Image.Transpose | None, *, as_stored: bool
) -> NDArray[np.float32]:
    """Read the mask of an image, turned as its image was.

    Args:
        path: the mask's file.
        size: width and height of the image.
        turn: how the image was turned from what is stored.
        as_stored: whether the image's EXIF orientation was left aside.

    Returns:
        ``(H, W)`` float32 in [0, 1], of the image's size.

    Raises:
        InputError: as :func:`read_mask`; when the mask has another shape, or nothing says whether to turn it.
    """
    pixels, own = decode(path, as_stored=as_stored)
    height, width = pixels.shape[:2]
    if turn is not None and own is None:
        if turn in SIDEWAYS and (width, height) == size[::-1] and width != height:
            stored = Image.fromarray(np.rint(255 * _meaning(pixels, path)).astype(np.uint8))
            return np.asarray(np.asarray(stored.transpose(turn)) / 255, dtype=np.float32)
        if not (turn in SIDEWAYS and width != height):
            raise InputError(
                f"{path}: its image is stored turned (EXIF), and nothing says whether the mask is; save the image anew"
            )
    if (width, height) != size:
        raise InputError(f"{path}: mask is {width}x{height}, expected {size[0]}x{size[1]} as its image")
    return _meaning(pixels, path)


def _meaning(pixels: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    """Return what a mask's pixels, ``(H, W, 3)`` or ``(H, W, 4)``, keep."""
    alpha = pixels[..., 3:]
    if alpha.size and alpha.min() < alpha.max():
        return np.asarray(alpha[..., 0])
    if alpha.size and alpha.max() < 1:
        raise InputError(f"{path}: mask is transparent everywhere, expected white where the object is")
    colours = pixels[..., :3]
    brightest = colours.max(axis=-1)
    kept = brightest > 0
    # A sole colour beside black (or alone) is what is kept, however dark it is: programs write 0 and 1.
    if not kept.any() or (colours[kept] == colours[kept][0]).all():
        return np.asarray(kept.astype(np.float32))
    if (brightest - colours.min(axis=-1)).max() > _NOISE:
        raise InputError(
            f"{path}: mask has several colours, expected white where the object is and black elsewhere"
        )
    if brightest.max() < _WHITE or _flat(brightest) > _MOST_FLAT:
        values = np.unique(np.rint(255 * brightest)).astype(int).tolist()
        raise InputError(
            f"{path}: mask holds the values {', '.join(map(str, values[:6]))}{', ...' * (len(values) > 6)} (labels?), "
            "expected white where the object is and black elsewhere"
        )
    return np.asarray(brightest)


def _flat(values: NDArray[np.float32]) -> float:
    """Return the fraction of pixels that lie, with their eight neighbours, in one value between black and
    white."""
    if min(values.shape) < 3:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(values, (3, 3))
    middle = windows[..., 1, 1]
    between = (middle > 0) & (middle < _WHITE)
    return float((between & (windows == middle[..., None, None]).all(axis=(2, 3))).mean())
