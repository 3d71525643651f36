"""Reader for a single ``transforms.json``, as nerfstudio and instant-ngp write it."""

from __future__ import annotations

import posixpath
from pathlib import Path
from typing import Any

import numpy as np

from gridreg.errors import InputError
from gridreg.scenes.blender import read_frames
from gridreg.scenes.extent import Extent
from gridreg.scenes.files import read_json
from gridreg.scenes.frames import Frame, SceneFiles

__all__ = ["EXTENT_KEY", "read_transforms"]

EXTENT_KEY = "gridreg"
"""Key under which a prepared scene states its near, far and bounds."""


def read_transforms(folder: Path) -> SceneFiles:
    """Read ``transforms.json`` without opening an image.

    Its own ``train_filenames`` and ``test_filenames`` (or ``val_filenames``) split it, as nerfstudio's
    `DataParser` has it; without them every eighth frame is held out for testing. Intrinsics may stand once or
    in every frame, OPENCV distortion is undone when the images are read, and a frame's ``mask_path`` becomes
    its alpha. Cameras belong to images as they are
    stored: neither instant-ngp nor nerfstudio turns by EXIF orientation.

    Raises:
        InputError: for a missing file or key, a number that is not one, a pose that is not rigid, or a
            fisheye lens.
    """
    path = folder / "transforms.json"
    content = read_json(path)
    frames = read_frames(path, content)
    extent = _read_extent(content, path)
    notes: tuple[str, ...] = ()
    frames, test = _own_split(content, frames, path)
    if test:
        notes = (f"{path}: its own split, {len(frames) - len(test)} training and {len(test)} test frames",)
    return SceneFiles.held_out(
        folder,
        frames,
        path,
        test=test,
        notes=notes,
        opaque=True,
        as_stored=True,
        extent=extent,
        metric=extent is not None and content[EXTENT_KEY].get("unit") == "metre",
    )


def _own_split(content: dict[str, Any], frames: list[Frame], path: Path) -> tuple[list[Frame], set[str]]:
    """Return the frames that a file's own lists of names hold, and the paths of those for testing (none: no
    lists)."""
    listed = {}
    known = {_plain(frame.file_path): frame.file_path for frame in frames}
    for split in ("train", "test", "val"):
        names = content.get(f"{split}_filenames") or []
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise InputError(f"{path}: '{split}_filenames' is not a list of file names")
        for name in names:
            if _plain(name) not in known:
                raise InputError(f"{path}: '{split}_filenames' names {name!r}, which is not among the frames")
        listed[split] = {known[_plain(name)] for name in names}
    test = listed["test"] or listed["val"]
    if not test and listed["train"]:
        test = set(known.values()) - listed["train"]
    train = listed["train"] or set(known.values()) - test
    if train & test:
        raise InputError(f"{path}: its own split trains on a test frame, {sorted(train & test)[0]!r}")
    return [frame for frame in frames if frame.file_path in train | test], test


def _plain(name: str) -> str:
    return posixpath.normpath(name.replace("\\", "/"))


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
