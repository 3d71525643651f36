"""Reader for Blender scenes: nerf_synthetic, and what the BlenderNeRF add-on exports."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

from gridreg.errors import InputError
from gridreg.scenes.files import find_inside, read_json
from gridreg.scenes.frames import Frame, SceneFiles, StatedIntrinsics
from gridreg.scenes.gate import check_pose
from gridreg.scenes.lens import LensDistortion

__all__ = ["read_blender", "read_camera", "read_frames"]

_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_LENSES = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "FULL_OPENCV", "PERSPECTIVE")


def read_blender(folder: Path) -> SceneFiles:
    """Read ``transforms_train.json`` and ``transforms_test.json`` without opening an image.

    Where no test images are (BlenderNeRF exports cameras of test views alone), ``transforms_val.json`` serves
    instead, or every eighth training frame is held out; a note says so. ``camera_angle_y`` is ignored:
    BlenderNeRF derives it from the sensor's height, which does not fit images of another aspect; ``fl_x`` and
    ``fl_y`` count, and square pixels are assumed where they are missing.

    Raises:
        InputError: for a missing file or key, a number that is not one, or a pose that is not rigid.
    """
    source = folder / "transforms_train.json"
    train = read_frames(source, read_json(source))
    notes: tuple[str, ...] = ()
    tests = [folder / f"transforms_{split}.json" for split in ("test", "val")]
    for path in (path for path in tests if path.exists()):
        content = read_json(path)
        test = read_frames(path, content) if content.get("frames") != [] else []
        if any(find_inside(folder, frame.file_path, frame.where) for frame in test):
            return SceneFiles(folder, train, test, {"train": source, "test": path}, notes=notes)
        notes += (f"{path}: lists {len(test)} frames and none of their images is there",)
    if not notes:
        raise InputError(f"{tests[0]}: file not found")
    held = f"every 8th frame of {source} is held out instead"
    return SceneFiles.held_out(folder, train, source, notes=(f"{'; '.join(notes)}; {held}",))


def read_frames(path: Path, content: dict[str, Any]) -> list[Frame]:
    """Read the frame list of a transforms file.

    Raises:
        InputError: see :func:`read_blender`.
    """
    frames = content.get("frames")
    if frames is None:
        raise InputError(f"{path}: key 'frames' is missing")
    if not isinstance(frames, list) or not frames:
        raise InputError(f"{path}: 'frames' is not a list with at least one frame")
    return [_read_frame(content, entry, f"{path}: frame {i}") for i, entry in enumerate(frames)]


def _read_frame(shared: dict[str, Any], entry: object, where: str) -> Frame:
    if not isinstance(entry, dict):
        raise InputError(f"{where}: found a {type(entry).__name__}, expected a JSON object")
    for key in ("file_path", "transform_matrix"):
        if key not in entry:
            raise InputError(f"{where}: key '{key}' is missing")
    if not isinstance(entry["file_path"], str):
        raise InputError(f"{where}: file_path is a {type(entry['file_path']).__name__}, expected a string")
    # A frame's own intrinsics win over those of the file.
    if "fl_x" in entry:
        shared = {key: value for key, value in shared.items() if key != "camera_angle_x"}
    camera = read_camera({**shared, **entry}, where)
    mask_path = entry.get("mask_path")
    if mask_path is not None and not isinstance(mask_path, str):
        raise InputError(f"{where}: mask_path is a {type(mask_path).__name__}, expected a string")
    pose = check_pose(entry["transform_matrix"], where)
    return Frame(entry["file_path"], pose, camera, where, mask_path)


def read_camera(values: dict[str, Any], where: str) -> StatedIntrinsics:
    """Read intrinsics by the keys of nerf_synthetic and instant-ngp.

    Raises:
        InputError: when a number is out of range, the lens is a fisheye, or no focal length is there.
    """
    lens = values.get("camera_model", "FISHEYE" if values.get("is_fisheye") else "OPENCV")
    if not isinstance(lens, str) or lens.upper() not in _LENSES:
        raise InputError(f"{where}: camera_model is {lens!r}, expected one of {', '.join(_LENSES)}")
    distortion = LensDistortion(**{key: _number(values, key, where) or 0.0 for key in _DISTORTION})
    angle = _number(values, "camera_angle_x", where)
    fx, fy = _number(values, "fl_x", where), _number(values, "fl_y", where)
    if fx is None and angle is None:
        raise InputError(f"{where}: key 'camera_angle_x' (or 'fl_x') is missing")
    if angle is not None and not 0 < angle < math.pi:
        raise InputError(f"{where}: camera_angle_x is {angle}, expected radians between 0 and pi")
    for key, focal in (("fl_x", fx), ("fl_y", fy)):
        if focal is not None and focal <= 0:
            raise InputError(f"{where}: {key} is {focal}, expected a positive number of pixels")
    width, height = _number(values, "w", where), _number(values, "h", where)
    for key, edge in (("w", width), ("h", height)):
        if edge is not None and edge < 1:
            raise InputError(f"{where}: {key} is {edge}, expected a positive number of pixels")
    return StatedIntrinsics(
        angle_x=angle,
        fx=fx,
        fy=fy,
        cx=_number(values, "cx", where),
        cy=_number(values, "cy", where),
        width=_whole(width),
        height=_whole(height),
        distortion=distortion,
    )


def _number(values: dict[str, Any], key: str, where: str) -> float | None:
    value = values.get(key)
    if value is None:
        return None
    # Not math.isfinite: JSON allows integers too large for it.
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e100:
        raise InputError(f"{where}: {key} is {str(value)[:40]!r}, expected a finite number")
    return float(value)


def _whole(edge: float | None) -> float | None:
    """Return whole numbers as integers: the text of a fingerprint has them so."""
    return int(edge) if edge is not None and edge == round(edge) else edge
