"""Writing the built-in scene in Blender's format, whole or not at all."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from gridreg.errors import InputError
from gridreg.machine import remove_left_behind, temporary_beside
from gridreg.scenes.builtin.cameras import FIELD_OF_VIEW, test_poses, train_poses
from gridreg.scenes.builtin.raycast import cast, render_rgba
from gridreg.scenes.files import read_json
from gridreg.scenes.load import BUILTIN_MARKER

__all__ = ["builtin_depth", "builtin_scene", "write_once"]

Array = NDArray[np.float64]

_VERSION = 1
"""Changes with every change of a pixel, so that old folders are written anew."""


def builtin_scene(folder: str | Path, *, size: int = 200) -> Path:
    """Write the built-in scene (unless it is there already) and return its folder.

    The folder holds 18 frames in ``transforms_train.json``, of which protocol ``builtin8`` trains on
    the first 8 and the others serve validation, and 25 in ``transforms_test.json``. At 200x200 it takes
    a few seconds; the time grows with the square of the size.

    Args:
        folder: an existing or new folder to put it in, such as a cache folder.
        size: width and height of the images in pixels.

    Returns:
        The scene folder, inside ``folder``; its name tells the size.

    Raises:
        InputError: when the folder cannot be written, or something else is in the scene's place.
    """
    if size < 8:
        raise InputError(f"size: found {size}, expected at least 8 pixels")
    target = Path(folder) / f"lighthouse_{size}"
    needed = [f"{split}/r_{k}.png" for split, poses in _lists().items() for k in range(len(poses))]
    needed += [f"transforms_{split}.json" for split in _lists()]
    return write_once(target, _marker(size), needed, lambda fresh: _write(fresh, size))


def write_once(
    target: Path, marker: dict[str, object], needed: list[str], write: Callable[[Path], None]
) -> Path:
    """Write a folder whole or not at all, unless it is there already, and return it.

    Args:
        target: the folder.
        marker: what its `BUILTIN_MARKER` says; another one is written anew.
        needed: files without which it is not complete.
        write: makes and fills the folder that it is given.

    Raises:
        InputError: when the folder cannot be written, or something else is in its place.
    """
    # Also where the scene is complete: a process may have died right after it.
    with suppress(OSError):
        remove_left_behind(target.parent)
    if _is_complete(target, marker, needed):
        return target
    if target.exists() and not (target / BUILTIN_MARKER).is_file():
        raise InputError(
            f"{target}: exists but is not the built-in scene; move it away or choose another folder"
        )
    scratch = temporary_beside(target)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        scratch.mkdir()
        fresh = scratch / "scene"
        write(fresh)
        _write_json(fresh / BUILTIN_MARKER, marker)
        if target.exists():
            target.rename(scratch / "old")
        fresh.rename(target)
    except OSError as error:
        # Another process may have finished the same scene in the meantime.
        if not _is_complete(target, marker, needed):
            raise InputError(f"{target}: the built-in scene cannot be written ({error.strerror})") from None
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return target


def builtin_depth(pose: Tensor, intrinsics: Tensor, height: int, width: int) -> Tensor:
    """Return the exact distance along the ray through each pixel's centre.

    Args:
        pose: ``(4, 4)`` camera-to-world.
        intrinsics: ``(4,)`` fx, fy, cx, cy in pixels.
        height: rows.
        width: columns.

    Returns:
        ``(height, width)`` float32 world units, ``inf`` where the ray hits nothing.
    """
    hits = cast(
        pose.detach().cpu().numpy().astype(np.float64),
        intrinsics.detach().cpu().numpy().astype(np.float64),
        np.arange(width, dtype=np.float64) + 0.5,
        np.arange(height, dtype=np.float64) + 0.5,
    )
    return torch.from_numpy(hits.distance().astype(np.float32))


def _lists() -> dict[str, list[Array]]:
    return {"train": train_poses(), "test": test_poses()}


def _marker(size: int) -> dict[str, object]:
    return {
        "scene": "built-in lighthouse of gridreg, not a published benchmark",
        "version": _VERSION,
        "size": size,
    }


def _is_complete(target: Path, marker: dict[str, object], needed: list[str]) -> bool:
    try:
        found = read_json(target / BUILTIN_MARKER)
    except InputError:
        return False
    return bool(found == marker) and all((target / name).is_file() for name in needed)


def _write(folder: Path, size: int) -> None:
    focal = 0.5 * size / np.tan(0.5 * FIELD_OF_VIEW)
    intrinsics = np.array([focal, focal, 0.5 * size, 0.5 * size])

    def write_view(path: Path, pose: Array) -> None:
        rgba = np.rint(render_rgba(pose, intrinsics, size, size) * 255).astype(np.uint8)
        Image.fromarray(rgba).save(path)

    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        views = []
        for split, poses in _lists().items():
            (folder / split).mkdir(parents=True)
            views += [
                pool.submit(write_view, folder / split / f"r_{k}.png", pose) for k, pose in enumerate(poses)
            ]
            frames = [
                {"file_path": f"./{split}/r_{k}", "transform_matrix": pose.tolist()}
                for k, pose in enumerate(poses)
            ]
            _write_json(
                folder / f"transforms_{split}.json", {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
            )
        for view in views:
            view.result()


def _write_json(path: Path, content: dict[str, object]) -> None:
    path.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")
