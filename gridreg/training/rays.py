"""Training pixels and the rays through them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from gridreg import ops
from gridreg.attach.handle import Handle
from gridreg.errors import InputError
from gridreg.rendering import OccupancyGrid, Rays, box_intersection, pixel_rays
from gridreg.scenes import Scene, Views, ndc_rays
from gridreg.scenes.pixels import as_floats


@dataclass(frozen=True)
class Batch:
    """Rays of one iteration.

    Args:
        rays: ``R`` of them.
        rgba: ``(S, 4)`` pixels that the first ``S`` rays are compared with; alpha is NaN where it is not known.
        jitter: ``(R,)`` in [0, 1), the fraction of a step by which each ray's samples are shifted.
        patch: ``(count, height, width)`` of the patches that the last rays form; None: there are none.
    """

    rays: Rays
    rgba: Tensor
    jitter: Tensor
    patch: tuple[int, int, int] | None = None


@dataclass(frozen=True)
class NdcWarp:
    """Maps rays of forward-facing cameras to normalised device coordinates, see `gridreg.scenes.ndc_rays`.

    Args:
        intrinsics: fx, fy, cx, cy in pixels of the average camera.
        height, width: of its images, pixels.
    """

    intrinsics: tuple[float, float, float, float]
    height: int
    width: int

    def __call__(self, rays: Rays) -> Rays:
        """The mapped rays; distances along them are those of the normalised coordinates.

        A ray that does not look along -z meets no plane before the cameras; it is sent out of the box.
        """
        forward = rays.directions[:, 2:] < -1e-3
        safe = torch.where(forward, rays.directions, rays.directions.new_tensor([0.0, 0.0, -1.0]))
        lens = torch.tensor(self.intrinsics, device=rays.origins.device)
        origins, directions = ndc_rays(rays.origins, safe, lens, self.height, self.width)
        seen = forward & torch.isfinite(origins) & torch.isfinite(directions)
        nowhere, away = origins.new_tensor([0.0, 0.0, -10.0]), origins.new_tensor([0.0, 0.0, -1.0])
        seen = seen.all(dim=-1, keepdim=True)
        return Rays(torch.where(seen, origins, nowhere), torch.where(seen, directions, away))


def warp_of(scene: Scene) -> NdcWarp | None:
    """The map from the rays of a scene's cameras to the field's coordinates; None where these are the world's."""
    if not scene.ndc:
        return None
    fx, fy, cx, cy = scene.train.intrinsics.double().mean(dim=0).tolist()
    return NdcWarp((fx, fy, cx, cy), scene.train.height, scene.train.width)


def known_alpha(scene: Scene, carve: bool) -> Tensor | None:
    """Alpha that the silhouettes of opaque images on one colour tell, if they count; None: the images' own."""
    if scene.train.backdrop is None:
        return None
    alpha = scene.train.silhouettes
    return alpha if carve and not scene.ndc else torch.full_like(alpha, torch.nan)


def behind(
    batch: Batch, scene: Scene, handle: Handle, generator: torch.Generator, *, black: bool
) -> tuple[Tensor, Tensor]:
    """The colour behind each ray ``(R, 3)``, and the opacity of its target ``(R,)``, NaN where nothing tells it.

    Args:
        batch: of ``R`` rays.
        scene: its background, and whether images are opaque on one colour.
        handle: may draw backgrounds.
        generator: source of the random numbers.
        black: something else is put behind the rays later.
    """
    count, default = len(batch.rays), scene.background.to(batch.rgba).expand(len(batch.rays), 3)
    opacity = batch.rgba.new_full((count,), torch.nan)
    if black:
        return torch.zeros_like(default), opacity
    opacity[: len(batch.rgba)] = batch.rgba[:, 3]
    if scene.train.backdrop is not None and bool(opacity.isnan().all()):
        return default, opacity
    background = handle.background(count, generator, scene.background.to(batch.rgba))
    if background is None:
        return default, opacity
    if scene.train.backdrop is None:
        return background.expand(count, 3), opacity
    # Where paper may be seen, another background would be answered with walls of the paper's colour.
    return torch.where(opacity.isnan()[:, None], default, background), opacity


class RayBank:
    """All pixels of the training views; rays are made for those that are drawn.

    Args:
        views: ``V`` images of ``H x W``.
        warp: maps their rays to the field's coordinates; None: these are the world's.
        reshuffle: draw every active pixel once before any is drawn again, instead of with replacement.
        alpha: ``(V, H, W)`` instead of the images' own, NaN where it is not known.
    """

    def __init__(
        self,
        views: Views,
        warp: NdcWarp | None = None,
        *,
        reshuffle: bool = False,
        alpha: Tensor | None = None,
    ) -> None:
        self.views, self.warp, self.reshuffle = views, warp, reshuffle
        self.count, self.height, self.width = views.pixels.shape[:3]
        pixels = views.pixels
        if alpha is not None:
            pixels = torch.cat([as_floats(pixels[..., :3]), alpha[..., None]], dim=-1)
        self.pixels = pixels.reshape(-1, 4)
        count = self.pixels.shape[0]
        # Half of the memory while they can be counted so.
        kind = torch.int32 if count < 2**31 else torch.int64
        self.active = torch.arange(count, dtype=kind, device=self.pixels.device)
        self.waiting = self.active[:0]
        self.drawn = self.active[:0]

    def rays(self, index: Tensor) -> Rays:
        """Rays through pixels given by flat index ``(R,)``."""
        view = index // (self.height * self.width)
        inside = index % (self.height * self.width)
        rays = pixel_rays(
            self.views.poses[view], self.views.intrinsics[view], inside // self.width, inside % self.width
        )
        return rays if self.warp is None else self.warp(rays)

    def draw(self, count: int, generator: torch.Generator) -> tuple[Rays, Tensor]:
        """``count`` random rays among the active ones and their RGBA ``(R, 4)``.

        Raises:
            InputError: if no ray is active.
        """
        if not len(self.active):
            raise InputError(
                f"training images: all of the {len(self.pixels)} pixels are transparent and see no occupied cell, "
                "expected some to train on"
            )
        if self.reshuffle:
            index = self._next(count, generator)
        else:
            chosen = torch.randint(self.active.shape[0], (count,), generator=generator)
            index = self.active[chosen.to(self.active.device)]
        self.drawn = index.long()
        return self.rays(self.drawn), as_floats(self.pixels[self.drawn])

    @property
    def drawn_views(self) -> Tensor:
        """The view of each ray of the last draw, ``(R,)``."""
        return self.drawn // (self.height * self.width)

    def _next(self, count: int, generator: torch.Generator) -> Tensor:
        """The next pixels in a random order, and then of other random orders."""
        while len(self.waiting) < count:
            order = torch.randperm(self.active.shape[0], generator=generator)
            self.waiting = torch.cat([self.waiting, self.active[order.to(self.active.device)]])
        chosen, self.waiting = self.waiting[:count], self.waiting[count:]
        return chosen

    def restrict(self, useful: Callable[[Rays], Tensor], chunk: int = 1 << 15) -> None:
        """Keep the active pixels whose ray is useful, and all that are not transparent."""
        parts = torch.split(self.active, chunk)
        kept = [useful(self.rays(part.long())) | (self.pixels[part.long(), 3] != 0) for part in parts]
        self.active = self.active[torch.cat(kept)]
        self.waiting = self.active[:0]


def meets(rays: Rays, occupancy: OccupancyGrid, near: float, far: float) -> Tensor:
    """Whether each ray passes an occupied cell, probed at half a cell: ``(R,)`` bool."""
    nodes = torch.tensor(occupancy.resolution, device=occupancy.bounds.device)
    step = float(((occupancy.bounds[1] - occupancy.bounds[0]) / nodes).min()) / 2
    t_min, t_max = box_intersection(rays, occupancy.bounds, near, far)
    jitter = torch.full_like(t_min, 0.5)
    arguments = ops.MarchArguments(
        rays.origins, rays.directions, t_min, t_max, step, occupancy.cells, occupancy.bounds, jitter
    )
    offsets = ops.march(arguments)[0]
    return offsets[1:] > offsets[:-1]
