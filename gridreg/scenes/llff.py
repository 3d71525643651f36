"""Reader for forward-facing LLFF scenes, and their normalised device coordinates.

Source: Mildenhall et al. 2019 (LLFF) for the file, NeRF (Mildenhall et al. 2020), appendix C, for the
coordinates.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gridreg.errors import InputError
from gridreg.scenes.extent import Extent
from gridreg.scenes.frames import Frame, SceneFiles, StatedIntrinsics, check_pose

__all__ = ["ndc_rays", "read_llff"]

_IMAGES = (".jpg", ".jpeg", ".png")
# x and y reach a little past the image's edge at the near plane; z = -1 is the near plane, z = 1 infinity.
_NDC_BOX = ((-1.5, -1.67, -1.0), (1.5, 1.67, 1.0))


def read_llff(folder: Path) -> SceneFiles:
    """Read ``poses_bounds.npy`` and the list of images in ``images/`` without opening one.

    As in NeRF, the world is scaled so that the nearest depth becomes 4/3, and centred on the average
    camera, which then looks along -z; the near plane of the normalised coordinates lies at depth 1.

    Raises:
        InputError: for a missing or malformed file, or a number of images that is not that of the poses.
    """
    path = folder / "poses_bounds.npy"
    rows = _read_rows(path)
    images = sorted(p.name for p in (folder / "images").glob("*") if p.suffix.lower() in _IMAGES)
    if len(images) != len(rows):
        raise InputError(
            f"{path}: holds {len(rows)} poses, but {folder / 'images'} holds {len(images)} images"
        )
    matrices = rows[:, :15].reshape(-1, 3, 5)
    # LLFF's columns are down, right, back; ours are right, up, back.
    poses = np.stack([matrices[..., 1], -matrices[..., 0], matrices[..., 2], matrices[..., 3]], axis=-1)
    poses = np.stack([check_pose(pose, f"{path}: pose {i}") for i, pose in enumerate(poses)])
    scale = 1 / (0.75 * float(rows[:, 15].min()))
    poses[:, :3, 3] *= scale
    poses = np.linalg.inv(_average_pose(poses)) @ poses
    frames = []
    for i, (image, pose) in enumerate(zip(images, poses, strict=True)):
        height, width, focal = matrices[i, :, 4]
        camera = StatedIntrinsics(fx=focal, width=round(width), height=round(height))
        frames.append(Frame(f"images/{image}", pose, camera, f"{path}: pose {i}"))
    bounds = np.array(_NDC_BOX)
    far = float(np.linalg.norm(bounds[1] - bounds[0]))
    return SceneFiles.held_out(
        folder, frames, path, opaque=True, as_stored=True, ndc=True, extent=Extent(0.0, far, bounds)
    )


def _read_rows(path: Path) -> NDArray[np.float64]:
    try:
        rows = np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path}: not a NumPy file ({' '.join(str(error).split())})") from None
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
