"""Own images: gathering them in a scene folder, and cameras for them by structure from motion."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from gridreg.errors import InputError
from gridreg.scenes import structure_from_motion
from gridreg.scenes.board import Board
from gridreg.scenes.board_cameras import look_for_board, place_on_board
from gridreg.scenes.colmap import frames_of_model, mask_of
from gridreg.scenes.colmap_model import read_model
from gridreg.scenes.decoding import decode, open_image
from gridreg.scenes.files import EXTENSIONS, list_images, read_bytes, resolve_inside
from gridreg.scenes.frames import Frame, SceneFiles
from gridreg.scenes.images import copy_upright, fit_mask, read_rgba
from gridreg.scenes.markers import OPENCV, has_opencv
from gridreg.scenes.photographs import doubtful_photographs

__all__ = ["Copied", "attach_masks", "copy_frames", "find_photographs", "shrink_images"]

Progress = Callable[[str], None]

_HEIC = (".heic", ".heif")
_FEWEST = 4
_ADVICE = (
    "take more images, each sharing two thirds of its view with its neighbours, sharp, without zooming, "
    "of things with texture (a newspaper under the object helps)"
)


class Copied(NamedTuple):
    """An image copied into a scene folder.

    Attributes:
        path: below ``images``.
        size: width and height in pixels.
        turn: how it was turned from what was stored.
    """

    path: Path
    size: tuple[int, int]
    turn: Image.Transpose | None


def copy_images(source: Path, scene: Path, progress: Progress) -> list[Copied]:
    """Copy the images of a folder upright into ``scene/images``; what is left aside is said.

    Raises:
        InputError: for a folder without images, or a damaged one.
    """
    names = list_images(source)
    stems = [Path(name).stem for name in names if Path(name).suffix.lower() not in _HEIC]
    # A telephone that stores both writes one photograph twice.
    twice = [name for name in names if Path(name).suffix.lower() in _HEIC and Path(name).stem in stems]
    names = [name for name in names if name not in twice]
    suffixes = {path.suffix for path in source.iterdir() if path.is_file() and path.name[0] != "."}
    others = sorted(suffix for suffix in suffixes if suffix and suffix.lower() not in EXTENSIONS)
    if not names:
        found = f"only {', '.join(others)} files" if others else "nothing"
        raise InputError(f"{source}: found {found}, expected images (.jpg, .png, .webp, .tif or .heic)")
    if len(names) < _FEWEST:
        raise InputError(f"{source}: found {len(names)} images, expected at least {_FEWEST}; {_ADVICE}")
    if twice or others:
        progress(f"left aside {', '.join([*twice, *(f'{suffix} files' for suffix in others)])}")
    copied = [Copied(*copy_upright(source / name, scene / "images" / name)) for name in names]
    for doubt in doubtful_photographs([image.path for image in copied]):
        progress(doubt)
    return copied


def find_photographs(
    source: Path, scene: Path, scratch: Path, progress: Progress
) -> tuple[list[Frame], NDArray[np.float64] | None, list[Copied], Board | None]:
    """Copy photographs into a scene folder and find their cameras: by the sheet, if they show it, else by structure
    from motion.

    Returns:
        Frames of those that could be placed, ``(P, 3)`` points on surfaces, all of them, and the sheet.

    Raises:
        InputError: as :func:`copy_images` and :func:`find_cameras`.
    """
    copied = copy_images(source, scene, progress)
    if not has_opencv():
        progress(f"markers are not looked for, that needs {OPENCV}")
        return *find_cameras(scene, copied, scratch, progress), copied, None
    progress("markers")
    seen = look_for_board(copied)
    if seen is None:
        return *find_cameras(scene, copied, scratch, progress), copied, None
    placed = place_on_board(*seen, progress)
    for name, reason in placed.left_out.items():
        progress(f"{name} is left out: {reason}")
    corners = np.concatenate(list(placed.board.corners.values()))
    return placed.frames, np.pad(corners, ((0, 0), (0, 1))), copied, placed.board


def find_cameras(
    scene: Path, copied: list[Copied], scratch: Path, progress: Progress
) -> tuple[list[Frame], NDArray[np.float64] | None]:
    """Find the cameras of the images in ``scene/images`` by pycolmap, one lens for each size.

    Returns:
        Frames of the registered images, and ``(P, 3)`` points on surfaces, in the world of the model.

    Raises:
        InputError: when pycolmap is missing or fails, or fewer than 4 images got a camera.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise InputError(
            "pycolmap is not installed: pip install 'gridreg[colmap]', or give a folder with a COLMAP model"
        )
    flat = scratch / "flat"
    sizes = sorted({image.size for image in copied})
    for image in copied:
        folder = flat if len(sizes) == 1 else flat / str(sizes.index(image.size))
        folder.mkdir(parents=True, exist_ok=True)
        _write_opaque(image.path, folder / image.path.name)
    log = scratch / "log.txt"
    registered = 0
    with log.open("wb") as errors:
        command = [sys.executable, structure_from_motion.__file__, str(flat), str(scratch)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True) as worker:
            for line in worker.stdout or ():
                stage, *count = line.split() or [""]
                if stage == "registered":
                    registered = int(count[0])
                elif stage == "placed":
                    progress(f"{count[0]} of {len(copied)} images placed")
                elif stage in structure_from_motion.STAGES:
                    progress(stage)
    if worker.returncode != 0:
        last = (log.read_text(errors="replace").strip().splitlines() or ["no message"])[-1]
        raise InputError(f"pycolmap failed with status {worker.returncode}: {last}")
    if registered < _FEWEST:
        raise InputError(f"only {registered} of {len(copied)} images could be registered; {_ADVICE}")
    if registered < len(copied) / 2:
        progress(f"only {registered} of {len(copied)} images could be registered; {_ADVICE}")
    model = read_model(scratch / "model")
    frames = [
        replace(frame, file_path=f"images/{Path(frame.file_path).name}")
        for frame in frames_of_model(model, scene, "images", "pycolmap")
    ]
    return frames, model.points if len(model.points) else None


def _write_opaque(path: Path, target: Path) -> None:
    """Give features nothing to hold on to where an image is transparent: a flat grey."""
    rgba = read_rgba(path, opaque=True)
    if (rgba[..., 3] == 1).all():
        target.write_bytes(read_bytes(path, "image"))
        return
    flat = rgba[..., :3] * rgba[..., 3:] + 0.5 * (1 - rgba[..., 3:])
    Image.fromarray(np.rint(255 * flat).astype(np.uint8)).save(target)


def copy_frames(files: SceneFiles, scene: Path) -> tuple[list[Frame], list[Copied]]:
    """Copy the images and masks of a scene with cameras into another folder and return frames that name
    them there.

    Raises:
        InputError: for an image or mask that is missing or damaged, outside of its scene, or of another size
            than its camera.
    """
    frames = sorted([*files.train, *files.test], key=lambda frame: frame.file_path)
    paths = [resolve_inside(files.folder, frame.file_path, frame.where) for frame in frames]
    names = [path.name for path in paths]
    if len(set(names)) != len(names):
        names = ["_".join(path.relative_to(files.folder.resolve()).parts) for path in paths]
    made: list[Frame] = []
    copied: list[Copied] = []
    for frame, path, name in zip(frames, paths, names, strict=True):
        target = scene / "images" / name
        copied.append(
            Copied(*copy_upright(path, target, stated=frame.camera.size, as_stored=files.as_stored))
        )
        size, first = copied[-1].size, copied[0].size
        wanted = frame.camera.width or first[0], frame.camera.height or first[1]
        if abs(size[0] - wanted[0]) >= 1 or abs(size[1] - wanted[1]) >= 1:
            raise InputError(f"{path}: image is {size[0]}x{size[1]}, expected {wanted[0]:g}x{wanted[1]:g}")
        mask_path = None
        if frame.mask_path is not None:
            mask = resolve_inside(files.folder, frame.mask_path, frame.where)
            mask_path = _copy_mask(mask, scene, copied[-1], as_stored=files.as_stored)
        made.append(replace(frame, file_path=f"images/{copied[-1].path.name}", mask_path=mask_path))
    return made, copied


def attach_masks(frames: list[Frame], masks: Path, scene: Path, copied: list[Copied]) -> list[Frame]:
    """Copy a mask for every frame from a folder of masks and return frames that name them.

    Raises:
        InputError: for a mask that is missing or damaged, or does not fit its image.
    """
    images = {image.path.name: image for image in copied}
    named = []
    for frame in frames:
        image = images[Path(frame.file_path).name]
        mask = masks / mask_of(masks, image.path.name)
        named.append(replace(frame, mask_path=_copy_mask(mask, scene, image, as_stored=False)))
    return named


def _copy_mask(mask: Path, scene: Path, image: Copied, *, as_stored: bool) -> str:
    """Write what the mask of an image means, black and white, into ``scene/masks`` and return its path there."""
    (scene / "masks").mkdir(exist_ok=True)
    place = f"masks/{image.path.name}.png"
    kept = fit_mask(mask, image.size, image.turn, as_stored=as_stored)
    Image.fromarray(np.rint(255 * kept).astype(np.uint8)).save(scene / place)
    return place


def shrink_images(frames: list[Frame], scene: Path, size: tuple[int, int], longest: int) -> tuple[int, int]:
    """Reduce images and masks of ``size`` in place, so that their longer edge is at most ``longest`` pixels.

    Returns:
        Width and height of the images now.
    """
    fraction = longest / max(size)
    if fraction >= 1:
        return size
    new = max(1, round(size[0] * fraction)), max(1, round(size[1] * fraction))
    for path in [scene / name for frame in frames for name in (frame.file_path, frame.mask_path) if name]:
        with open_image(path) as opened:
            image = opened
            if opened.mode not in ("L", "LA", "RGB", "RGBA"):
                image = Image.fromarray(np.rint(255 * decode(path).pixels).astype(np.uint8))
            image.resize(new, Image.Resampling.BOX).save(path, quality=95)
    return new
