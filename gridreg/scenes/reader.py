"""Opening frames: images of one size, masked, reduced and undistorted, with their intrinsics."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.machine import check_memory
from gridreg.scenes.decoding import decode, image_size
from gridreg.scenes.files import resolve_inside
from gridreg.scenes.frames import Frame, SceneFiles
from gridreg.scenes.gate import check_cameras
from gridreg.scenes.images import area_mean, fit_mask
from gridreg.scenes.lens import undistort
from gridreg.scenes.pixels import as_bytes, as_floats
from gridreg.scenes.protocols import Protocol
from gridreg.scenes.views import Views, World

__all__ = ["OpenedFrames", "ViewReader"]

# Longer images of own photographs are reduced on reading, unless a size is asked for.
_LONGEST = 1280


@dataclass(frozen=True)
class OpenedFrames:
    """Frames with their images, in the world of their files.

    Attributes:
        pixels: ``(V, H, W, 4)``, see `Views`.
        poses: ``(V, 4, 4)`` float64 camera-to-world.
        intrinsics: ``(V, 4)`` float64, of these images.
        names: ``V`` names fit for file names.
        ids: ``V`` indices into the frame list.
        fingerprint: hash of pixels and cameras.
    """

    pixels: Tensor
    poses: NDArray[np.float64]
    intrinsics: NDArray[np.float64]
    names: tuple[str, ...]
    ids: tuple[int, ...]
    fingerprint: str

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return int(self.pixels.shape[2]), int(self.pixels.shape[1])

    def views(self, world: World) -> Views:
        """Return the views in the coordinates of the scene."""
        poses = torch.tensor(world.inward(self.poses), dtype=torch.float32)
        intrinsics = torch.tensor(self.intrinsics, dtype=torch.float32)
        return Views(self.pixels, poses, intrinsics, self.names, self.ids)


class ViewReader:
    """Reads selected frames of a scene, all to one size.

    Args:
        files: what was found in the scene folder.
        protocol: its size rule holds where ``size`` is not given.
        size: wanted width in pixels.
        opaque: accept images without alpha beside others with alpha.
    """

    def __init__(self, files: SceneFiles, protocol: Protocol, size: int | None, opaque: bool) -> None:
        self._files, self._protocol, self._size, self._opaque = files, protocol, size, opaque
        self._stored: tuple[int, int] | None = None
        self._reduced: tuple[int, ...] = (1, 1)
        self._with_alpha: Path | None = None
        self._without_alpha: Path | None = None
        self.notes: list[str] = []

    def expect(self, frames: list[Frame]) -> None:
        """Refuse, before any image is read, more of them than the memory can hold.

        Raises:
            InputError: naming how much they would take; when the first image is not there.
        """
        if not frames:
            return
        path = resolve_inside(self._files.folder, frames[0].file_path, frames[0].where)
        width, height = image_size(path)
        factor = self._factor(width, height, path)
        pixels = len(frames) * (width // factor) * (height // factor)
        # As read, four floats a pixel; in training three more, over the background.
        what = f"{self._files.folder}: {len(frames)} images of {width // factor}x{height // factor}"
        check_memory(28 * pixels, f"{what} (choose fewer views, or a smaller width with size)")

    def read(self, frames: list[Frame], ids: tuple[int, ...]) -> OpenedFrames:
        """Return the frames with these indices.

        Raises:
            InputError: for an image that is missing, damaged, of another size, or without alpha where others
                have it.
        """
        digest = hashlib.sha256()
        pixels = torch.empty(0, *self._reduced, 4)
        intrinsics = np.zeros((len(ids), 4))
        paths: list[Path] = []
        for k, i in enumerate(ids):
            path = resolve_inside(self._files.folder, frames[i].file_path, frames[i].where)
            digest.update(f"{i} {frames[i].camera.fingerprint}".encode() + frames[i].pose.tobytes())
            image, intrinsics[k] = self._read_frame(path, frames[i], digest)
            levels = as_bytes(image) if not k or pixels.dtype == torch.uint8 else None
            if not k:
                # One tensor from the first on: a list that is joined at the end takes twice the memory.
                kind = torch.float32 if levels is None else torch.uint8
                pixels, self._reduced = torch.empty(len(ids), *image.shape, dtype=kind), image.shape[:2]
            elif levels is None:
                pixels = as_floats(pixels)
            pixels[k] = torch.from_numpy(image if levels is None else levels)
            if path in paths:
                raise InputError(
                    f"{frames[i].where}: names {path.name}, as another frame does; expected an image each"
                )
            paths.append(path)
        wheres = [f"{frames[i].where} ({path.name})" for i, path in zip(ids, paths, strict=True)]
        poses = np.array([frames[i].pose for i in ids]).reshape(-1, 4, 4)
        check_cameras(poses, intrinsics.astype(np.float32), (pixels.shape[2], pixels.shape[1]), wheres)
        names = _unique_names(self._files.folder, paths)
        return OpenedFrames(pixels, poses, intrinsics, names, ids, digest.hexdigest())

    def _read_frame(
        self, path: Path, frame: Frame, digest: hashlib._Hash
    ) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
        camera, as_stored = frame.camera, self._files.as_stored
        image, turn = decode(path, stated=camera.size, as_stored=as_stored)
        image = self._with_four_channels(image, path)
        height, width = image.shape[:2]
        self._check_size(path, frame, width, height)
        if frame.mask_path is not None:
            mask_file = resolve_inside(self._files.folder, frame.mask_path, frame.where)
            mask = fit_mask(mask_file, (width, height), turn, as_stored=as_stored)
            image = np.concatenate([image[..., :3], image[..., 3:] * mask[..., None]], axis=-1)
        factor = self._factor(width, height, path)
        digest.update(f"{image.shape} {factor}".encode() + image.tobytes())
        image = area_mean(image[: height - height % factor, : width - width % factor], factor)
        try:
            values = np.array(camera.intrinsics(width, height)) / factor
        except InputError as error:
            raise InputError(f"{frame.where}: {error}") from None
        if camera.distortion:
            image, values = undistort(image, values, camera.distortion, frame.where)
        return image, values

    def _with_four_channels(self, image: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
        """Add alpha to an opaque image; a scene of which some images have alpha and others none is
        doubtful."""
        if image.shape[-1] == 4:
            self._with_alpha = self._with_alpha or path
        elif self._without_alpha is None:
            self._without_alpha = path
            if not self._files.opaque:
                self.notes.append(f"{path}: image has no alpha channel; such images are taken as opaque")
        if self._with_alpha and self._without_alpha and not self._opaque:
            raise InputError(
                f"{self._without_alpha}: image has no alpha channel, expected RGBA as {self._with_alpha.name} "
                "(or opaque, --opaque, to take it as opaque)"
            )
        if image.shape[-1] == 4:
            return image
        return np.concatenate([image, np.ones_like(image[..., :1])], axis=-1)

    def _check_size(self, path: Path, frame: Frame, width: int, height: int) -> None:
        stated = frame.camera.width or width, frame.camera.height or height
        # BlenderNeRF states a fraction of a pixel where Blender renders at a percentage.
        if abs(stated[0] - width) >= 1 or abs(stated[1] - height) >= 1:
            expected = f"{stated[0]:g}x{stated[1]:g}"
            raise InputError(f"{path}: image is {width}x{height}, expected w x h of its camera, {expected}")
        self._stored = self._stored or (width, height)
        if (width, height) != self._stored:
            expected = f"{self._stored[0]}x{self._stored[1]}"
            raise InputError(f"{path}: image is {width}x{height}, expected {expected} as before")

    def _factor(self, width: int, height: int, path: Path) -> int:
        if self._size is not None:
            if self._size < 1 or width % self._size:
                raise InputError(
                    f"size: found {self._size}, expected a divisor of the width of {path}, {width}"
                )
            factor = width // self._size
        elif self._files.split_here and width != self._protocol.halve_at:
            factor = math.ceil(max(width, height) / _LONGEST)
            note = f"images of {width}x{height} are reduced to {width // factor}x{height // factor} (--size chooses)"
            if factor > 1 and note not in self.notes:
                self.notes.append(note)
            return factor
        else:
            factor = 2 if width == self._protocol.halve_at else 1
        if height % factor:
            raise InputError(f"{path}: image is {width}x{height}, expected edges divisible by {factor}")
        return factor


def _unique_names(folder: Path, paths: list[Path]) -> tuple[str, ...]:
    stems = [path.stem for path in paths]
    if len(set(stems)) == len(stems):
        return tuple(stems)
    root = folder.resolve()
    places = [
        path.relative_to(root) if path.is_relative_to(root) else Path(*path.parts[-2:]) for path in paths
    ]
    joined = ["_".join(place.with_suffix("").parts) for place in places]
    return tuple(joined if len(set(joined)) == len(joined) else ["_".join(place.parts) for place in places])
