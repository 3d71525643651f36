"""Patches of rays from cameras between the training cameras: no image tells what these see."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from gridreg.errors import InputError
from gridreg.rendering import Rays, pixel_rays
from gridreg.scenes import Views
from gridreg.scenes.extent import focus_point
from gridreg.training.rays import NdcWarp


def poses_between(first: Tensor, second: Tensor, share: Tensor, focus: Tensor) -> Tensor:
    """Cameras on the way from one to another.

    Axes are mixed and made orthonormal; so are distances to the focus along the axis, and what a camera is aside of it.
    Between two cameras that look at the focus lies one that does, between two that look ahead one that does.

    Args:
        first, second: camera-to-world matrices ``(P, 4, 4)``, looking along -z with y up.
        share: ``(P,)`` of the second, in [0, 1].
        focus: ``(3,)`` what the cameras look at, world units.

    Returns:
        ``(P, 4, 4)``. Between cameras that look at each other, where axes cancel out, those of the first.

    Example:
        >>> right, left = torch.eye(4), torch.eye(4)
        >>> right[0, 3], left[0, 3] = 1.0, -1.0
        >>> poses_between(right[None], left[None], torch.tensor([0.25]), torch.zeros(3))[0, :3, 3].tolist()
        [0.5, 0.0, 0.0]
    """

    def along(poses: Tensor) -> tuple[Tensor, Tensor]:
        """Distance of a camera behind the focus along its axis, and the rest beside that."""
        offset, axis = poses[:, :3, 3] - focus, poses[:, :3, 2]
        distance = (offset * axis).sum(dim=-1, keepdim=True)
        return distance, offset - distance * axis

    s = share[:, None]
    mixed = torch.lerp(first, second, share[:, None, None])
    backward = normalize(mixed[:, :3, 2], dim=-1)
    right = torch.linalg.cross(mixed[:, :3, 1], backward)
    sound = (mixed[:, :3, 2].norm(dim=-1) > 1e-3) & (right.norm(dim=-1) > 1e-3)
    right = normalize(right, dim=-1)
    axes = torch.stack([right, torch.linalg.cross(backward, right), backward], dim=-1)
    axes = torch.where(sound[:, None, None], axes, first[:, :3, :3])
    (d1, aside1), (d2, aside2) = along(first), along(second)
    found = mixed.clone()
    found[:, :3, :3] = axes
    found[:, :3, 3] = focus + torch.lerp(aside1, aside2, s) + axes[:, :, 2] * torch.lerp(d1, d2, s)
    return found


class UnseenPatches:
    """Draws square patches of rays from cameras between two training cameras.

    Such patches are what penalties on depth see of views without an image. Source: RegNeRF (Niemeyer et al. 2022)
    draws patches of 8x8 rays from unseen cameras, but places these in a box or on a sphere that it is told of.

    Args:
        views: the training views; one alone is its own neighbour.
        size: rays along each edge of a patch.
        warp: maps rays to the field's coordinates; None: these are the world's.

    Raises:
        InputError: a patch is larger than the images.
    """

    def __init__(self, views: Views, size: int, warp: NdcWarp | None = None) -> None:
        if size > min(views.height, views.width):
            raise InputError(
                f"train.patch_size: found {size}, expected no more than the images' "
                f"{min(views.height, views.width)} pixels"
            )
        self.views, self.size, self.warp = views, size, warp
        focus = focus_point(views.poses.double().cpu().numpy())
        self.focus = torch.from_numpy(focus).to(views.poses)

    def draw(self, count: int, generator: torch.Generator) -> Rays:
        """``count * size * size`` rays, patch by patch, each row by row."""
        poses, views, size = self.views.poses, len(self.views), self.size
        first = torch.randint(views, (count,), generator=generator)
        # Any but the first, where there is another.
        second = (first + torch.randint(1, max(2, views), (count,), generator=generator)) % views
        share = torch.rand(count, generator=generator)
        top = torch.randint(self.views.height - size + 1, (count, 1, 1), generator=generator)
        left = torch.randint(self.views.width - size + 1, (count, 1, 1), generator=generator)
        edge = torch.arange(size)
        rows = (top + edge[:, None]).expand(count, size, size).reshape(-1)
        columns = (left + edge).expand(count, size, size).reshape(-1)
        first, second = first.to(poses.device), second.to(poses.device)
        cameras = poses_between(poses[first], poses[second], share.to(poses), self.focus)
        rays = pixel_rays(
            cameras.repeat_interleave(size * size, dim=0),
            self.views.intrinsics[first].repeat_interleave(size * size, dim=0),
            rows.to(poses.device),
            columns.to(poses.device),
        )
        return rays if self.warp is None else self.warp(rays)
