"""COLMAP's sparse models, text and binary, as plain arrays.

Source: COLMAP documentation, "Output Format".
"""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.files import read_bytes, read_text

__all__ = ["ColmapCamera", "ColmapImage", "ColmapModel", "read_model"]

# Number and name of each camera model, and its parameters' names.
_MODELS: dict[int, tuple[str, tuple[str, ...]]] = {
    0: ("SIMPLE_PINHOLE", ("f", "cx", "cy")),
    1: ("PINHOLE", ("fx", "fy", "cx", "cy")),
    2: ("SIMPLE_RADIAL", ("f", "cx", "cy", "k1")),
    3: ("RADIAL", ("f", "cx", "cy", "k1", "k2")),
    4: ("OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")),
    6: ("FULL_OPENCV", ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
}
_NUMBERS = {name: number for number, (name, _) in _MODELS.items()}


@dataclass(frozen=True)
class ColmapCamera:
    """A camera: size in pixels and parameters by name."""

    model: str
    width: int
    height: int
    parameters: dict[str, float]


@dataclass(frozen=True)
class ColmapImage:
    """A registered image: world-to-camera quaternion (w, x, y, z) and translation, camera y down."""

    name: str
    camera_id: int
    quaternion: tuple[float, float, float, float]
    translation: tuple[float, float, float]


@dataclass(frozen=True)
class ColmapModel:
    """A sparse model: cameras by id, images in the order of their names, ``(P, 3)`` points."""

    cameras: dict[int, ColmapCamera]
    images: tuple[ColmapImage, ...]
    points: NDArray[np.float64]


def read_model(folder: Path) -> ColmapModel:
    """Read ``cameras``, ``images`` and ``points3D``, ``.bin`` or ``.txt``.

    Raises:
        InputError: for a missing, cut or malformed file, or a camera model that is no perspective lens.
    """
    binary = (folder / "images.bin").is_file()
    suffix = ".bin" if binary else ".txt"
    cameras_file, images_file = folder / f"cameras{suffix}", folder / f"images{suffix}"
    points_file = folder / f"points3D{suffix}"
    current = cameras_file
    try:
        cameras = dict((_binary_cameras if binary else _text_cameras)(cameras_file))
        current = images_file
        images = list((_binary_images if binary else _text_images)(images_file))
        current = points_file
        points = np.fromiter(
            (value for point in (_binary_points if binary else _text_points)(points_file) for value in point),
            dtype=np.float64,
        )
    except (ValueError, IndexError, struct.error, OverflowError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{current}: not a COLMAP file, or cut short ({error})") from None
    if not images:
        raise InputError(f"{images_file}: holds no registered image")
    for image in images:
        if image.camera_id not in cameras:
            raise InputError(
                f"{images_file}: image {image.name!r} has camera {image.camera_id}, not in {cameras_file}"
            )
    placed = points.reshape(-1, 3)
    if not (np.abs(placed) < 1e18).all():
        raise InputError(f"{points_file}: holds a point that is not finite, or too large for float32")
    ordered = tuple(sorted(images, key=lambda image: image.name))
    return ColmapModel(cameras, ordered, placed)


def _camera(model: str, width: int, height: int, values: list[float], path: Path) -> ColmapCamera:
    if model not in _NUMBERS:
        raise InputError(
            f"{path}: camera model {model} is not supported, expected one of {', '.join(_NUMBERS)}"
        )
    names = _MODELS[_NUMBERS[model]][1]
    if len(values) != len(names):
        raise InputError(f"{path}: camera model {model} has {len(values)} parameters, expected {len(names)}")
    if not np.isfinite(values).all() or values[0] <= 0:
        raise InputError(
            f"{path}: camera parameters {values} are not finite, or the focal length is not positive"
        )
    return ColmapCamera(model, width, height, dict(zip(names, values, strict=True)))


def _lines(path: Path) -> Iterator[str]:
    """Yield every line that is no comment, also empty ones: they matter in ``images.txt``."""
    # A list of all lines takes several times the memory of the text.
    text = io.StringIO(read_text(path), newline=None)
    yield from (line.rstrip("\n") for line in text if not line.startswith("#"))


def _text_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    for fields in filter(None, map(str.split, _lines(path))):
        values = [float(value) for value in fields[4:]]
        yield int(fields[0]), _camera(fields[1], int(fields[2]), int(fields[3]), values, path)


def _text_images(path: Path) -> Iterator[ColmapImage]:
    # Every image has two lines. The second one, its observations, may be empty; files of known poses often
    # lack it.
    awaited = False
    for line in _lines(path):
        if awaited and _are_observations(line):
            awaited = False
        elif line.strip():
            # The name is the rest of the line: it may hold spaces.
            *numbers, name = line.split(maxsplit=9)
            w, x, y, z, *translation = (float(value) for value in numbers[1:8])
            yield ColmapImage(name.rstrip(), int(numbers[8]), (w, x, y, z), _triple(translation))
            awaited = True


def _are_observations(line: str) -> bool:
    """Tell whether a line holds triples of numbers, or nothing; an image's name makes it another line."""
    fields = line.split()
    try:
        return len(fields) % 3 == 0 and bool(np.isfinite([float(field) for field in fields]).all())
    except ValueError:
        return False


def _text_points(path: Path) -> Iterator[tuple[float, float, float]]:
    for fields in filter(None, map(str.split, _lines(path))):
        yield _triple([float(value) for value in fields[1:4]])


def _triple(values: list[float]) -> tuple[float, float, float]:
    x, y, z = values
    return x, y, z


class _Bytes:
    """A little-endian file, read from front to back."""

    def __init__(self, path: Path) -> None:
        self._data, self._position = read_bytes(path), 0

    def take(self, form: str) -> tuple[float, ...]:
        values = struct.unpack_from("<" + form, self._data, self._position)
        self._position += struct.calcsize("<" + form)
        return values

    def count(self) -> int:
        (count,) = self.take("Q")
        return int(count)

    def skip(self, size: int) -> None:
        self._position += size
        if self._position > len(self._data):
            raise ValueError("file ends early")

    def word(self) -> str:
        end = self._data.index(b"\0", self._position)
        word = self._data[self._position : end].decode("utf-8")
        self._position = end + 1
        return word


def _binary_cameras(path: Path) -> Iterator[tuple[int, ColmapCamera]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        camera_id, number, width, height = (int(value) for value in data.take("iiQQ"))
        if number not in _MODELS:
            raise InputError(
                f"{path}: camera model {number} is not supported, expected one of {', '.join(_NUMBERS)}"
            )
        name, parameters = _MODELS[number]
        yield camera_id, _camera(name, width, height, list(data.take(f"{len(parameters)}d")), path)


def _binary_images(path: Path) -> Iterator[ColmapImage]:
    data = _Bytes(path)
    for _ in range(data.count()):
        _, w, x, y, z, *rest = data.take("i7di")
        name = data.word()
        data.skip(24 * data.count())
        yield ColmapImage(name, int(rest[3]), (w, x, y, z), _triple(rest[:3]))


def _binary_points(path: Path) -> Iterator[tuple[float, float, float]]:
    data = _Bytes(path)
    for _ in range(data.count()):
        _, x, y, z = data.take("Q3d")
        data.skip(3 + 8)
        data.skip(8 * data.count())
        yield x, y, z
