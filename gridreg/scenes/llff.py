"""Reader for forward-facing LLFF scenes, and their normalised device coordinates.

Source: Mildenhall et al. 2019 (LLFF) for the file, NeRF (Mildenhall et al. 2020), appendix C, for the
coordinates.
"""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes.decoding import image_size
from gridreg.scenes.extent import Extent
from gridreg.scenes.files import list_images, read_bytes
from gridreg.scenes.frames import Frame, SceneFiles, StatedIntrinsics
from gridreg.scenes.gate import check_pose

__all__ = ["ndc_rays", "read_llff"]

# x and y reach a little past the image's edge at the near plane; z = -1 is the near plane, z = 1 infinity.
_NDC_BOX = ((-1.5, -1.67, -1.0), (1.5, 1.67, 1.0))
# Cosine of the widest angle between a forward-facing camera and the average one: 60 degrees.
_FORWARD = 0.5


def read_llff(folder: Path) -> SceneFiles:
    """Read ``poses_bounds.npy`` and the list of images in ``images/`` (or a reduced ``images_8/``) without
    decoding one.

    As in NeRF, the world of forward-facing cameras is scaled so that the nearest depth becomes 4/3, and
    centred on the average camera, which then looks along -z; the near plane of the normalised coordinates
    lies at depth 1. Cameras around an object (LLFF's tools write them as well) keep their world, as
    normalised coordinates hold before one plane only.

    Raises:
        InputError: for a missing or malformed file, or a number of images that is not that of the poses.
    """
    path = folder / "poses_bounds.npy"
    rows = _read_rows(path)
    images = _images_folder(folder)
    names = list_images(images)
    if len(names) != len(rows):
        raise InputError(f"{path}: holds {len(rows)} poses, but {images} holds {len(names)} images")
    matrices = rows[:, :15].reshape(-1, 3, 5)
    # LLFF's columns are down, right, back; ours are right, up, back.
    poses = np.stack([matrices[..., 1], -matrices[..., 0], matrices[..., 2], matrices[..., 3]], axis=-1)
    poses = np.stack([check_pose(pose, f"{path}: pose {i}") for i, pose in enumerate(poses)])
    factor = _factor(images, names[0], matrices[0, :2, 4])
    forward = _look_forward(poses)
    extent: Extent | None = None
    notes: tuple[str, ...] = ()
    if forward:
        poses[:, :3, 3] *= 1 / (0.75 * float(rows[:, 15].min()))
        poses = np.linalg.inv(_average_pose(poses)) @ poses
        bounds = np.array(_NDC_BOX)
        extent = Extent(0.0, float(np.linalg.norm(bounds[1] - bounds[0])), bounds)
    else:
        notes = (
            f"{path}: cameras look in different directions, so nothing is forward-facing and the box is a cube",
        )
    frames = []
    for i, (name, pose) in enumerate(zip(names, poses, strict=True)):
        height, width, focal = matrices[i, :, 4] / factor
        camera = StatedIntrinsics(fx=focal, width=round(width), height=round(height))
        frames.append(Frame(f"{images.name}/{name}", pose, camera, f"{path}: pose {i}"))
    return SceneFiles.held_out(
        folder, frames, path, opaque=True, as_stored=True, ndc=forward, extent=extent, notes=notes
    )


def _images_folder(folder: Path) -> Path:
    """Return ``images``, or where there are reduced images alone (``images_4``, ``images_8``) the least
    reduced."""
    reduced = sorted(folder.glob("images_*"), key=lambda path: (len(path.name), path.name))
    return next((path for path in (folder / "images", *reduced) if path.is_dir()), folder / "images")


def _factor(images: Path, name: str, stated: NDArray[np.float64]) -> NDArray[np.float64] | float:
    """Return by what the images of a folder ``images_8`` are reduced: height, width, and for the focal
    length."""
    if images.name == "images":
        return 1.0
    width, height = image_size(images / name)
    factor = stated[0] / height, stated[1] / width
    if abs(factor[0] / factor[1] - 1) > 0.02 or min(factor) < 1:
        raise InputError(
            f"{images / name}: image is {width}x{height}, expected {stated[1]:g}x{stated[0]:g} reduced"
        )
    return np.array([*factor, factor[1]])


def _read_rows(path: Path) -> NDArray[np.float64]:
    data = read_bytes(path)
    try:
        # The header is Python's literals, and its parser warns of some of them.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            rows = np.load(io.BytesIO(data), allow_pickle=False)
    except Exception as error:
        raise InputError(f"{path}: not a NumPy file ({str(error) or type(error).__name__})") from None
    if (
        not isinstance(rows, np.ndarray)
        or rows.ndim != 2
        or rows.shape[1] != 17
        or rows.dtype.kind not in "fiu"
    ):
        raise InputError(f"{path}: found shape {getattr(rows, 'shape', None)}, expected (N, 17) numbers")
    rows = rows.astype(np.float64)
    if not len(rows) or not np.isfinite(rows).all():
        raise InputError(f"{path}: holds no poses, or numbers that are not finite")
    if (rows[:, [4, 9, 14]] <= 0).any() or (rows[:, 15] <= 0).any() or (rows[:, 15] >= rows[:, 16]).any():
        raise InputError(f"{path}: expected positive sizes and focal lengths, and depths 0 < near < far")
    return rows


def _look_forward(poses: NDArray[np.float64]) -> bool:
    """Tell whether all cameras look about the same way, and are held about the same way up."""
    backs = poses[:, :3, 2]
    mean = backs.mean(axis=0)
    together = bool((backs @ mean > _FORWARD * np.linalg.norm(mean)).all())
    return together and bool(np.linalg.norm(np.cross(poses[:, :3, 1].mean(axis=0), mean)) > 1e-3)


def _average_pose(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the ``(4, 4)`` pose in the middle of the cameras that looks where they look on average."""
    back = poses[:, :3, 2].sum(axis=0)
    back /= np.linalg.norm(back)
    right = np.cross(poses[:, :3, 1].sum(axis=0), back)
    right /= np.linalg.norm(right)
    middle = np.eye(4)
    middle[:3] = np.stack([right, np.cross(back, right), back, poses[:, :3, 3].mean(axis=0)], axis=-1)
    return middle


def ndc_rays(
    origins: Tensor, directions: Tensor, intrinsics: Tensor, height: int, width: int, near: float = 1.0
) -> tuple[Tensor, Tensor]:
    """Map rays of forward-facing cameras (those that look along -z) to normalised device coordinates.

    A mapped ray starts on the near plane, z = -1, and would reach z = 1 at infinity; its direction has
    length 1, like that of every ray here.

    Args:
        origins: ``(..., 3)``, world.
        directions: ``(..., 3)``, world, with negative z.
        intrinsics: ``(4,)`` fx, fy, cx, cy in pixels of the average camera.
        height: rows.
        width: columns.
        near: depth of the near plane, world units.

    Returns:
        Origins and unit directions, ``(..., 3)`` each.

    Source: NeRF, appendix C, equations 25 and 26.
    """
    shift = -(near + origins[..., 2]) / directions[..., 2]
    origins = origins + shift[..., None] * directions
    ox, oy, oz = origins.unbind(-1)
    dx, dy, dz = directions.unbind(-1)
    across, along = -2 * intrinsics[0] / width, -2 * intrinsics[1] / height
    start = torch.stack([across * ox / oz, along * oy / oz, 1 + 2 * near / oz], dim=-1)
    way = torch.stack([across * (dx / dz - ox / oz), along * (dy / dz - oy / oz), -2 * near / oz], dim=-1)
    return start, torch.nn.functional.normalize(way, dim=-1)
