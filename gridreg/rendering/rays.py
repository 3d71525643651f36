"""Rays from cameras, and where they meet a box."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """A batch of rays in world coordinates.

    Args:
        origins: ``(R, 3)``, world units.
        directions: ``(R, 3)``, length 1, so that distances along a ray are world units.
    """

    origins: Tensor
    directions: Tensor

    def __post_init__(self) -> None:
        if self.origins.shape != self.directions.shape or self.origins.shape[-1:] != (3,):
            raise ValueError(
                f"rays: origins {tuple(self.origins.shape)} and directions {tuple(self.directions.shape)} "
                "must both have the shape (R, 3)"
            )

    def __len__(self) -> int:
        return self.origins.shape[0]

    def __getitem__(self, which: slice | Tensor) -> Rays:
        return Rays(self.origins[which], self.directions[which])


def pixel_rays(poses: Tensor, intrinsics: Tensor, rows: Tensor, columns: Tensor) -> Rays:
    """Rays through the centres of pixels, one camera per ray.

    Args:
        poses: camera-to-world matrices ``(R, 4, 4)`` or ``(4, 4)``, looking along -z with y up.
        intrinsics: ``(R, 4)`` or ``(4,)``: fx, fy, cx, cy in pixels.
        rows, columns: ``(R,)`` pixel indices; the centre of a pixel lies at index + 0.5.

    Example:
        >>> pose = torch.eye(4)
        >>> rays = pixel_rays(pose, torch.tensor([10., 10., 2., 2.]), torch.tensor([1]), torch.tensor([1]))
        >>> [round(v, 3) for v in rays.directions[0].tolist()]
        [-0.05, 0.05, -0.998]
    """
    fx, fy, cx, cy = intrinsics.unbind(-1)
    x = (columns.to(poses.dtype) + 0.5 - cx) / fx
    y = -(rows.to(poses.dtype) + 0.5 - cy) / fy
    local = torch.stack([x, y, -torch.ones_like(x)], dim=-1)
    directions = torch.einsum("...ij,...j->...i", poses[..., :3, :3], local)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    origins = poses[..., :3, 3].expand(directions.shape)
    return Rays(origins.contiguous(), directions.contiguous())


def camera_rays(pose: Tensor, intrinsics: Tensor, height: int, width: int) -> Rays:
    """Rays of a whole image, row by row: ``R = height * width``.

    Args:
        pose: camera-to-world matrix ``(4, 4)``.
        intrinsics: ``(4,)``: fx, fy, cx, cy in pixels.
        height, width: pixels.
    """
    rows, columns = torch.meshgrid(
        torch.arange(height, device=pose.device), torch.arange(width, device=pose.device), indexing="ij"
    )
    return pixel_rays(pose, intrinsics, rows.reshape(-1), columns.reshape(-1))


def box_intersection(
    rays: Rays, bounds: Tensor, near: float | Tensor = 0.0, far: float | Tensor = 1e10
) -> tuple[Tensor, Tensor]:
    """Distances at which rays enter and leave an axis-aligned box (slab method, Kay and Kajiya 1986).

    Args:
        rays: ``R`` rays.
        bounds: ``(2, 3)`` lower and upper corner, world units.
        near, far: the interval is clipped to these distances, world units; numbers or ``(R,)``.

    Returns:
        ``t_min``, ``t_max``, both ``(R,)``. A ray that misses has ``t_max == t_min``.
    """
    tiny = torch.finfo(rays.directions.dtype).tiny ** 0.5
    safe = torch.where(rays.directions.abs() < tiny, torch.full_like(rays.directions, tiny), rays.directions)
    at_lower = (bounds[0] - rays.origins) / safe
    at_upper = (bounds[1] - rays.origins) / safe
    near_t, far_t = torch.as_tensor(near).to(bounds), torch.as_tensor(far).to(bounds)
    enter = torch.minimum(at_lower, at_upper).amax(dim=-1).clamp(min=near_t, max=far_t)
    leave = torch.maximum(at_lower, at_upper).amin(dim=-1).clamp(min=near_t, max=far_t)
    return enter, torch.maximum(enter, leave)
