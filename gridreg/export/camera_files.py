"""Camera paths as files: a JSON frame list as NeRF programs write it, without images."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gridreg.errors import InputError
from gridreg.rendering.cameras import Camera, Lens
from gridreg.scenes import IN_PLACE, World
from gridreg.scenes.files import read_json
from gridreg.scenes.gate import check_cameras, check_pose
from gridreg.training.files import write_json

_LENS_KEYS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def save_cameras(
    path: str | Path, cameras: Sequence[Camera], world: World = IN_PLACE, *, about: str = ""
) -> None:
    """Write a camera file, whole or not at all.

    Args:
        path: the JSON file.
        cameras: one for each frame.
        world: where their coordinates lie in the world of the file.
        about: a note that is written along.

    Raises:
        InputError: if the place is not writable or the disk is full.
    """
    frames = []
    for camera in cameras:
        (fx, fy, cx, cy), lens = camera.lens.intrinsics, camera.lens
        values = (fx, fy, cx, cy, lens.width, lens.height)
        frames.append(
            {**dict(zip(_LENS_KEYS, values, strict=True)), "transform_matrix": _outward(camera, world)}
        )
    write_json(path, {**({"about": about} if about else {}), "frames": frames})


def _outward(camera: Camera, world: World) -> list[list[float]]:
    pose = camera.pose.double().cpu().numpy()
    pose[:3, 3] = world.outward(pose[:3, 3]) if world != IN_PLACE else pose[:3, 3]
    return [[float(value) for value in row] for row in pose]


@np.errstate(all="ignore")
def load_cameras(path: str | Path, lens: Lens | None = None, world: World = IN_PLACE) -> list[Camera]:
    """Read a camera file: what `save_cameras` writes, or any ``transforms.json`` (without its images).

    Every frame has a ``transform_matrix``. The lens (``fl_x``, or ``camera_angle_x`` in radians; optionally
    ``fl_y``, ``cx``, ``cy``; ``w``, ``h``) is taken from the frame, else from the top of the file, else from
    ``lens``.

    Args:
        path: the file.
        lens: for what the file leaves out.
        world: where the wanted coordinates lie in the world of the file.

    Raises:
        InputError: if the file is missing, is not such a list, lacks a key, or holds what is not a rigid
            pose.
    """
    path = Path(path)
    data = read_json(path)
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames:
        raise InputError(
            f"{path}: found no list 'frames', expected at least one frame with a transform_matrix"
        )
    cameras = []
    for number, frame in enumerate(frames):
        where = f"{path}, frame {number}"
        if not isinstance(frame, dict) or "transform_matrix" not in frame:
            raise InputError(f"{where}: has no transform_matrix")
        pose = world.inward(check_pose(frame["transform_matrix"], where)[None])[0]
        camera = Camera(torch.from_numpy(pose).float(), _lens({**data, **frame}, lens, where))
        size = camera.lens.width, camera.lens.height
        check_cameras(camera.pose[None], [camera.lens.intrinsics], size, [where])
        cameras.append(camera)
    return cameras


def _lens(data: dict[str, Any], default: Lens | None, where: str) -> Lens:
    if not any(key in data for key in ("fl_x", "camera_angle_x")):
        if default is None:
            raise InputError(f"{where}: has no fl_x and no camera_angle_x, expected one of them")
        return default
    width = _number(data, "w", None if default is None else default.width, where)
    height = _number(data, "h", None if default is None else default.height, where)
    if width != int(width) or height != int(height):
        raise InputError(f"{where}: found w={width}, h={height}, expected whole pixels")
    if "fl_x" in data:
        fx = _number(data, "fl_x", None, where)
    else:
        angle = torch.tensor(_number(data, "camera_angle_x", None, where), dtype=torch.float64)
        fx = float(width / 2 / torch.tan(angle / 2))
    fy = _number(data, "fl_y", fx, where)
    centre = _number(data, "cx", width / 2, where), _number(data, "cy", height / 2, where)
    try:
        return Lens((fx, fy, *centre), int(height), int(width))
    except InputError as error:
        raise InputError(f"{where}: {error}") from None


def _number(data: dict[str, Any], key: str, default: float | None, where: str) -> float:
    value = data.get(key, default)
    if value is None:
        raise InputError(f"{where}: has no {key}")
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e9:
        raise InputError(f"{where}: found {key}={value!r}, expected a number")
    return float(value)
