"""The box that a mesh is cut to: set in the viewer, kept in a file, given by numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.files import read_json
from gridreg.training.files import write_json

Box = NDArray[np.float64]


def load_crop(words: Sequence[str]) -> Box:
    """A box ``(2, 3)``: its lower and upper corner, in the world of the scene's files.

    Args:
        words: six numbers, or the name of a file that `save_crop` wrote.

    Raises:
        InputError: for anything else, or a box without volume.
    """
    try:
        values = read_json(words[0])["bounds"] if len(words) == 1 else [float(word) for word in words]
        box = np.array(values, dtype=np.float64).reshape(2, 3)
    except (KeyError, TypeError, ValueError):
        raise InputError(
            f"crop: found {' '.join(words)!r}, expected X0 Y0 Z0 X1 Y1 Z1 or a file that the viewer has saved"
        ) from None
    return checked_crop(box)


def checked_crop(box: Box) -> Box:
    """Return a box ``(2, 3)`` in float64.

    Raises:
        InputError: for another shape, numbers that are not finite, or a box without volume.
    """
    box = np.asarray(box, dtype=np.float64)
    if box.shape != (2, 3) or not np.isfinite(box).all() or not (box[0] < box[1]).all():
        raise InputError(f"crop: found {box.tolist()}, expected a lower and a larger upper corner")
    return box


def save_crop(path: str | Path, box: Box) -> None:
    """Write a box ``(2, 3)`` of the scene's files' world, whole or not at all.

    Raises:
        InputError: if the place is not writable.
    """
    write_json(path, {"bounds": np.round(box, 6).tolist()})
