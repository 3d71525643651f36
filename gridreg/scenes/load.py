"""`load_scene`: a folder and a protocol in, a scene out; only the selected frames are opened."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes.blender import read_blender
from gridreg.scenes.extent import blender_extent
from gridreg.scenes.frames import Frame, SceneFiles, resolve_inside
from gridreg.scenes.images import area_mean, read_rgba
from gridreg.scenes.protocols import Protocol, get_protocol
from gridreg.scenes.views import Scene, Views, background_colour

__all__ = ["BUILTIN_MARKER", "load_scene"]

BUILTIN_MARKER = "builtin.json"
"""File that marks a folder as the built-in scene."""


def load_scene(
    folder: str | Path,
    protocol: str | Protocol = "dietnerf8",
    *,
    size: int | None = None,
    test: Sequence[int] | None = None,
    validation: int | Sequence[int] | None = None,
    background: str | Sequence[float] | Tensor | None = None,
    near: float | None = None,
    far: float | None = None,
    bounds: Sequence[Sequence[float]] | Tensor | None = None,
    opaque: bool = False,
) -> Scene:
    """Read a scene under a protocol.

    Args:
        folder: the scene folder.
        protocol: a name (see :func:`get_protocol`) or a protocol of one's own.
        size: width of the images in pixels; it must divide what is stored, and replaces the protocol's rule.
        test: indices into the test frames instead of the protocol's; an empty one reads none.
        validation: indices into the training frames, or how many to take, evenly spread, of those that the
            protocol does not train on.
        background: instead of the protocol's.
        near: world units, instead of what the format or the cameras say.
        far: likewise.
        bounds: ``(2, 3)`` lower and upper corner, likewise.
        opaque: accept images without alpha as opaque.

    Raises:
        InputError: one line that names the file or argument, what was found and what is expected.
    """
    folder = Path(folder)
    protocol = get_protocol(protocol) if isinstance(protocol, str) else protocol
    files = _read_folder(folder)
    positions = np.stack([frame.pose[:3, 3] for frame in files.train])
    train_ids = _checked(protocol.train.select(positions), files, "train", f"protocol {protocol.name}")
    if test is None:
        test_positions = np.stack([frame.pose[:3, 3] for frame in files.test])
        test_ids = _checked(protocol.test.select(test_positions), files, "test", f"protocol {protocol.name}")
    else:
        test_ids = _checked(tuple(test), files, "test", "test")
    validation_ids = _validation_ids(validation, train_ids, files)

    reader = _ViewReader(folder, protocol, size, opaque)
    train, fingerprint = reader.read(files.train, train_ids)
    test_views, _ = reader.read(files.test, test_ids)
    validation_views = None if validation is None else reader.read(files.train, validation_ids)[0]
    extent = blender_extent(
        train.poses.numpy().astype(np.float64),
        train.intrinsics.numpy().astype(np.float64),
        (train.width, train.height),
    )
    return Scene(
        name=folder.resolve().name,
        protocol=protocol.name,
        train=train,
        test=test_views,
        near=extent.near if near is None else near,
        far=extent.far if far is None else far,
        bounds=_bounds(extent.bounds if bounds is None else bounds),
        background=background_colour(protocol.background if background is None else background),
        fingerprint=fingerprint,
        builtin=(folder / BUILTIN_MARKER).is_file(),
        validation=validation_views,
    )


def _read_folder(folder: Path) -> SceneFiles:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such scene folder")
    if (folder / "transforms_train.json").is_file():
        return read_blender(folder)
    raise InputError(f"{folder}: not a scene, expected transforms_train.json and transforms_test.json")


def _checked(ids: tuple[int, ...], files: SceneFiles, split: str, by: str) -> tuple[int, ...]:
    count = len(files.train if split == "train" else files.test)
    for i in ids:
        if isinstance(i, bool) or not isinstance(i, int) or not 0 <= i < count:
            raise InputError(
                f"{by}: view {i!r} is not in {files.sources[split]}, which lists frames 0 to {count - 1}"
            )
    if len(set(ids)) != len(ids):
        raise InputError(f"{by}: a view is listed twice in {list(ids)}")
    return ids


def _validation_ids(
    wanted: int | Sequence[int] | None, train_ids: tuple[int, ...], files: SceneFiles
) -> tuple[int, ...]:
    if wanted is None:
        return ()
    if isinstance(wanted, int):
        free = [i for i in range(len(files.train)) if i not in set(train_ids)]
        if not 0 < wanted <= len(free):
            raise InputError(
                f"validation: found {wanted}, expected 1 to {len(free)} views outside the training views"
            )
        return tuple(free[(2 * k + 1) * len(free) // (2 * wanted)] for k in range(wanted))
    ids = _checked(tuple(wanted), files, "train", "validation")
    shared = sorted(set(ids) & set(train_ids))
    if shared:
        raise InputError(f"validation: views {shared} are training views")
    return ids


def _bounds(bounds: Sequence[Sequence[float]] | Tensor | NDArray[np.float64]) -> Tensor:
    try:
        return torch.as_tensor(np.asarray(bounds), dtype=torch.float32)
    except (TypeError, ValueError):
        raise InputError(f"bounds: found {bounds!r}, expected (2, 3) numbers") from None


class _ViewReader:
    """Opens frames, all to one size."""

    def __init__(self, folder: Path, protocol: Protocol, size: int | None, opaque: bool) -> None:
        self.folder, self.protocol, self.size, self.opaque = folder, protocol, size, opaque
        self.stored: tuple[int, int] | None = None
        self.reduced: tuple[int, ...] = (1, 1)

    def read(self, frames: list[Frame], ids: tuple[int, ...]) -> tuple[Views, str]:
        digest = hashlib.sha256()
        images: list[NDArray[np.float32]] = []
        intrinsics: list[NDArray[np.float64]] = []
        paths: list[Path] = []
        for i in ids:
            frame = frames[i]
            path = resolve_inside(self.folder, frame.file_path, frame.where)
            image = read_rgba(path, opaque=self.opaque)
            height, width = image.shape[:2]
            self._check_size(path, frame, width, height)
            factor = self._factor(width, height, path)
            values = np.array(frame.camera.intrinsics(width, height)) / factor
            digest.update(f"{i} {factor} {image.shape}".encode() + frame.pose.tobytes() + values.tobytes())
            digest.update(image.tobytes())
            images.append(area_mean(image, factor))
            self.reduced = images[-1].shape[:2]
            intrinsics.append(values)
            paths.append(path)
        views = Views(
            torch.from_numpy(np.stack(images) if images else np.zeros((0, *self.reduced, 4), np.float32)),
            torch.tensor(np.array([frames[i].pose for i in ids]).reshape(-1, 4, 4), dtype=torch.float32),
            torch.tensor(np.array(intrinsics).reshape(-1, 4), dtype=torch.float32),
            _unique_names(self.folder, paths),
            ids,
        )
        return views, digest.hexdigest()

    def _check_size(self, path: Path, frame: Frame, width: int, height: int) -> None:
        stated = (frame.camera.width or width, frame.camera.height or height)
        if (width, height) != stated:
            raise InputError(
                f"{path}: image is {width}x{height}, expected w x h of its camera, {stated[0]}x{stated[1]}"
            )
        if self.stored is None:
            self.stored = (width, height)
        if (width, height) != self.stored:
            raise InputError(
                f"{path}: image is {width}x{height}, expected {self.stored[0]}x{self.stored[1]} as before"
            )

    def _factor(self, width: int, height: int, path: Path) -> int:
        if self.size is None:
            factor = 2 if width == self.protocol.halve_at else 1
        elif self.size < 1 or width % self.size:
            raise InputError(f"size: found {self.size}, expected a divisor of the width of {path}, {width}")
        else:
            factor = width // self.size
        if height % factor:
            raise InputError(f"{path}: image is {width}x{height}, expected edges divisible by {factor}")
        return factor


def _unique_names(folder: Path, paths: list[Path]) -> tuple[str, ...]:
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return tuple(stems)
    root = folder.resolve()
    return tuple("_".join(path.relative_to(root).with_suffix("").parts) for path in paths)
