"""Opening frames: images of one size, masked, reduced and undistorted, with their intrinsics."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from gridreg.errors import InputError
from gridreg.scenes.frames import Frame, SceneFiles, resolve_inside
from gridreg.scenes.images import area_mean, read_mask, read_rgba
from gridreg.scenes.lens import undistort
from gridreg.scenes.protocols import Protocol
from gridreg.scenes.views import Views

__all__ = ["ViewReader"]


class ViewReader:
    """Reads selected frames of a scene, all to one size.

    Args:
        files: what was found in the scene folder.
        protocol: its size rule holds where ``size`` is not given.
        size: wanted width in pixels.
        opaque: accept images without alpha.
    """

    def __init__(self, files: SceneFiles, protocol: Protocol, size: int | None, opaque: bool) -> None:
        self._files, self._protocol, self._size = files, protocol, size
        self._opaque = opaque or files.opaque
        self._stored: tuple[int, int] | None = None
        self._reduced: tuple[int, ...] = (1, 1)

    def read(self, frames: list[Frame], ids: tuple[int, ...]) -> tuple[Views, str]:
        """Return the views of the frames with these indices, and a hash of their pixels and cameras.

        Raises:
            InputError: for an image that is missing, damaged, without alpha, or of another size.
        """
        digest = hashlib.sha256()
        images: list[NDArray[np.float32]] = []
        intrinsics: list[NDArray[np.float64]] = []
        paths: list[Path] = []
        for i in ids:
            path = resolve_inside(self._files.folder, frames[i].file_path, frames[i].where)
            digest.update(f"{i} {frames[i].camera.fingerprint}".encode() + frames[i].pose.tobytes())
            image, values = self._read_frame(path, frames[i], digest)
            images.append(image)
            intrinsics.append(values)
            paths.append(path)
        views = Views(
            torch.from_numpy(np.stack(images) if images else np.zeros((0, *self._reduced, 4), np.float32)),
            torch.tensor(np.array([frames[i].pose for i in ids]).reshape(-1, 4, 4), dtype=torch.float32),
            torch.tensor(np.array(intrinsics).reshape(-1, 4), dtype=torch.float32),
            _unique_names(self._files.folder, paths),
            ids,
        )
        return views, digest.hexdigest()

    def _read_frame(
        self, path: Path, frame: Frame, digest: hashlib._Hash
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        camera = frame.camera
        image = read_rgba(path, opaque=self._opaque, stated=camera.size, as_stored=self._files.as_stored)
        height, width = image.shape[:2]
        self._check_size(path, frame, width, height)
        if frame.mask_path is not None:
            mask_file = resolve_inside(self._files.folder, frame.mask_path, frame.where)
            mask = read_mask(mask_file)
            if mask.shape != (height, width):
                found = f"{mask.shape[1]}x{mask.shape[0]}"
                raise InputError(f"{mask_file}: mask is {found}, expected {width}x{height} as its image")
            image = np.concatenate([image[..., :3], image[..., 3:] * mask[..., None]], axis=-1)
        factor = self._factor(width, height, path)
        digest.update(f"{image.shape} {factor}".encode() + image.tobytes())
        image = area_mean(image, factor)
        values = np.array(camera.intrinsics(width, height)) / factor
        if camera.distortion:
            image, values = undistort(image, values, camera.distortion, frame.where)
        self._reduced = image.shape[:2]
        return image, values

    def _check_size(self, path: Path, frame: Frame, width: int, height: int) -> None:
        stated = (frame.camera.width or width, frame.camera.height or height)
        if (width, height) != stated:
            expected = f"{stated[0]}x{stated[1]}"
            raise InputError(f"{path}: image is {width}x{height}, expected w x h of its camera, {expected}")
        if self._stored is None:
            self._stored = (width, height)
        if (width, height) != self._stored:
            expected = f"{self._stored[0]}x{self._stored[1]}"
            raise InputError(f"{path}: image is {width}x{height}, expected {expected} as before")

    def _factor(self, width: int, height: int, path: Path) -> int:
        if self._size is None:
            factor = 2 if width == self._protocol.halve_at else 1
        elif self._size < 1 or width % self._size:
            raise InputError(f"size: found {self._size}, expected a divisor of the width of {path}, {width}")
        else:
            factor = width // self._size
        if height % factor:
            raise InputError(f"{path}: image is {width}x{height}, expected edges divisible by {factor}")
        return factor


def _unique_names(folder: Path, paths: list[Path]) -> tuple[str, ...]:
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return tuple(stems)
    root = folder.resolve()
    places = [path.relative_to(root) for path in paths]
    joined = ["_".join(place.with_suffix("").parts) for place in places]
    return tuple(joined if len(set(joined)) == len(joined) else ["_".join(place.parts) for place in places])
