"""Training pixels and the rays through them."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from gridreg.rendering import OccupancyGrid, Rays, backends, box_intersection, pixel_rays
from gridreg.scenes import Views

__all__ = ["RayBank", "meets"]


class RayBank:
    """All pixels of the training views; rays are made for those that are drawn.

    Args:
        views: ``V`` pictures of ``H x W``.
    """

    def __init__(self, views: Views) -> None:
        self.views = views
        self.count, self.height, self.width = views.rgba.shape[:3]
        self.pixels = views.rgba.reshape(-1, 4)
        self.active = torch.arange(self.pixels.shape[0], device=self.pixels.device)

    def rays(self, index: Tensor) -> Rays:
        """Rays through pixels given by flat index ``(R,)``."""
        view = index // (self.height * self.width)
        inside = index % (self.height * self.width)
        return pixel_rays(
            self.views.poses[view], self.views.intrinsics[view], inside // self.width, inside % self.width
        )

    def draw(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor]:
        """``count`` random rays among the active ones and their RGBA ``(R, 4)``, with replacement."""
        chosen = torch.randint(self.active.shape[0], (count,), generator=generator, device=self.active.device)
        index = self.active[chosen]
        return self.rays(index), self.pixels[index]

    def restrict(self, useful: Callable[[Rays], Tensor], chunk: int = 1 << 15) -> None:
        """Keep the active pixels whose ray is useful, and all that are not transparent."""
        parts = torch.split(self.active, chunk)
        kept = [part[useful(self.rays(part)) | (self.pixels[part, 3] > 0)] for part in parts]
        self.active = torch.cat(kept)


def meets(rays: Rays, occupancy: OccupancyGrid, near: float, far: float) -> Tensor:
    """Whether each ray passes an occupied cell, probed at half a cell: ``(R,)`` bool."""
    nodes = torch.tensor(occupancy.resolution, device=occupancy.bounds.device)
    step = float(((occupancy.bounds[1] - occupancy.bounds[0]) / nodes).min()) / 2
    t_min, t_max = box_intersection(rays, occupancy.bounds, near, far)
    jitter = torch.full_like(t_min, 0.5)
    offsets = backends.march(
        rays.origins, rays.directions, t_min, t_max, step, occupancy.cells, occupancy.bounds, jitter
    )[0]
    return offsets[1:] > offsets[:-1]
