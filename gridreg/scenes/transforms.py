"""Reader for a single ``transforms.json``, as nerfstudio and instant-ngp write it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gridreg.errors import InputError
from gridreg.scenes.blender import read_frames, read_json
from gridreg.scenes.extent import Extent
from gridreg.scenes.frames import SceneFiles

__all__ = ["EXTENT_KEY", "read_transforms"]

EXTENT_KEY = "gridreg"
"""Key under which a prepared scene states its near, far and bounds."""


def read_transforms(folder: Path) -> SceneFiles:
    """Read ``transforms.json`` without opening an image; every eighth frame is held out for testing.

    Intrinsics may stand once or in every frame, OPENCV distortion is undone when the images are read, and a
    frame's ``mask_path`` becomes its alpha.

    Raises:
        InputError: for a missing file or key, a number that is not one, a pose that is not rigid, or a
            fisheye lens.
    """
    path = folder / "transforms.json"
    content = read_json(path)
    return SceneFiles.held_out(
        folder, read_frames(path, content), path, opaque=True, extent=_read_extent(content, path)
    )


def _read_extent(content: dict[str, Any], path: Path) -> Extent | None:
    stated = content.get(EXTENT_KEY)
    if stated is None:
        return None
    try:
        bounds = np.array(stated["bounds"], dtype=np.float64)
        near, far = float(stated["near"]), float(stated["far"])
        if bounds.shape != (2, 3):
            raise ValueError
    except (KeyError, TypeError, ValueError, OverflowError):
        raise InputError(f"{path}: '{EXTENT_KEY}' does not hold near, far and (2, 3) bounds") from None
    return Extent(near, far, bounds)
